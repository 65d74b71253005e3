"""Files that are whole or absent, and modules on disk as safetensors beside JSON: nothing read here can run code."""

import contextlib
import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import nn
from torch.overrides import TorchFunctionMode

from envtf_lit.errors import DISK_FULL, UserError, did_you_mean

M = TypeVar("M", bound=nn.Module)
CALLS_PER_TENSOR = 100  # of torch in a constructor; those of this package make about ten


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; on success it takes `path`'s place, on failure it is removed.

    The block creates a file or a folder, and what it replaces is of the same kind.

    Raises:
        UserError: the disk is full, the place cannot be written, or a folder stands where a file shall, or a file where
            a folder shall. What was there stays.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if path.exists() and path.is_dir() != temporary.is_dir():
            kind = "folder" if path.is_dir() else "file"
            raise UserError(
                f"Cannot write {path}: a {kind} of that name stands there; move it, or choose another name."
            )
        if path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise UserError(f"No space left while writing {path}: free some disk space and run again.") from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise UserError(f"Cannot write {path}: {error.strerror}; choose a folder you may write to.") from error
        if error.filename is not None and temporary.is_relative_to(error.filename):  # else it is about something else
            blocker = next((parent for parent in path.parents if parent.is_file()), None)
            reason = f"{blocker} is a file, not a folder" if blocker else error.strerror
            raise UserError(f"Cannot write {path}: {reason}; choose another place.") from error
        raise
    finally:
        if os.path.isdir(temporary):  # these two say no where pathlib's would raise: below a file, of a long name
            shutil.rmtree(temporary)
        elif os.path.lexists(temporary):
            temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Writes a whole text or nothing; raises what `replacing` does."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_json(path: str | Path, content: Any) -> None:
    """Writes finite numbers, strings, lists and dictionaries; NaN and infinity raise ValueError."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """Reads a JSON file.

    Raises:
        UserError: the file is missing or is not JSON.
    """
    path = Path(path)
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: check the path, or run the stage that writes it.") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid JSON ({error}): write it anew.") from None


def save_module(folder: str | Path, module: nn.Module, *, kind: str, arguments: Mapping[str, Any]) -> None:
    """Writes `weights.safetensors` and `config.json` (the registry's `kind` and the constructor's `arguments`).

    No metadata goes into the safetensors file: several keys are written in random order, and equal weights must give
    equal bytes.
    """
    with replacing(folder) as temporary:
        temporary.mkdir()
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in module.state_dict().items()}
        (temporary / "weights.safetensors").write_bytes(save(tensors))  # so that a full disk is an OSError
        write_json(temporary / "config.json", {"kind": kind, "arguments": dict(arguments)})


def load_module(folder: str | Path, registry: Mapping[str, type[M]]) -> M:
    """Rebuilds what `save_module` wrote, in eval mode on the CPU, through a closed registry of classes.

    Memory and time are bounded by the size of the weights' file, whatever sizes `config.json` claims.

    Raises:
        UserError: no such folder, an unknown kind, arguments the class does not take, or weights that are damaged, of
            another shape, or not finite.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a model folder: it does not exist; run the stage that writes it.")
    config, weights = read_json(folder / "config.json"), folder / "weights.safetensors"
    kind = str(config.get("kind")) if isinstance(config, dict) else ""
    if kind not in registry:
        raise UserError(f"{folder}/config.json names the unknown kind {kind!r}: {did_you_mean(kind, registry)}")

    def build() -> M:
        try:
            return registry[kind](**config["arguments"])
        except (UserError, TypeError, KeyError, ValueError, ArithmeticError, RuntimeError) as error:
            text = f"{folder}/config.json does not describe a {kind} ({error}): save the model anew."
            raise UserError(text) from None

    found = _shapes(weights)
    with torch.device("meta"), _Outline(most_calls=CALLS_PER_TENSOR * len(found)):
        outline = build()
    _compare(outline, found, weights)
    module = build()  # of the file's own sizes, with the buffers that are in no file
    load_weights(module, weights)
    return module.eval()


class _Outline(TorchFunctionMode):
    """Bounds the work of a constructor that only has to tell its tensors' names and shapes, on the meta device.

    Args:
        most_calls: of torch; one more raises ValueError.
    """

    def __init__(self, most_calls: int) -> None:
        super().__init__()
        self.most_calls = most_calls

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.most_calls -= 1
        if self.most_calls < 0:
            raise ValueError("it has far more tensors than the weights' file")
        if getattr(func, "__name__", "") == "normal_":  # nothing to fill, and PyTorch would import for seconds to do so
            return args[0] if args else (kwargs or {})["tensor"]  # a tensor's method, or torch.nn.init's function
        return func(*args, **(kwargs or {}))


def load_weights(module: nn.Module, path: str | Path) -> None:
    """Fills `module` from a safetensors file.

    Raises:
        UserError: the file is missing, damaged, or holds other names or shapes than the module, or a parameter that is
            not finite, or a buffer that is NaN.
    """
    path = Path(path)
    _compare(module, _shapes(path), path)
    tensors = load_file(path)
    module.load_state_dict(tensors)
    parameters = dict(module.named_parameters())
    for name, tensor in tensors.items():
        broken = ~tensor.isfinite() if name in parameters else tensor.isnan()
        if broken.any():
            value = float(tensor[broken][0])
            raise UserError(f"{path} holds {value} in {name}: the training that wrote it diverged, so train it anew.")


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors in a safetensors file, from its header."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: check the path, or run the stage that writes it.") from None
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path} is not a safetensors file ({error}): write it anew.") from None


def _compare(module: nn.Module, found: dict[str, tuple[int, ...]], path: Path) -> None:
    expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    if expected != found:
        odd = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))[0]
        raise UserError(
            f"{path} does not fit the model: {odd} has shape {found.get(odd)} in the file and {expected.get(odd)} in "
            "the model; it was saved with another configuration, or by another version of envtf_lit: train it anew."
        )


def pick_device() -> torch.device:
    """The accelerator if there is one, else the CPU."""
    if torch.accelerator.is_available():
        accelerator = torch.accelerator.current_accelerator()
        assert accelerator is not None
        return accelerator
    return torch.device("cpu")
