"""Modules on disk, as safetensors beside JSON: nothing read here can run code."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import nn
from torch.overrides import TorchFunctionMode

from envtf_lit.divergence import OVERFLOW, diverged, unsound
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import check_plain, read_json, recover, replacing, write_json

M = TypeVar("M", bound=nn.Module)
MOST_HEADER = 4 << 20  # bytes of a weights' file that name its tensors; those of this package have thousands
CALLS_PER_TENSOR = 100  # of torch in a constructor; those of this package make about ten


def save_module(folder: str | Path, module: nn.Module, *, kind: str, arguments: Mapping[str, Any]) -> None:
    """Writes `weights.safetensors` and `config.json` (the registry's `kind` and the constructor's `arguments`).

    No metadata goes into the safetensors file: several keys are written in random order, and equal weights must give
    equal bytes.

    Raises:
        UserError: the module is what no sound training leaves (see `unsound`); nothing is written then.
    """
    found = unsound(module.state_dict(), dict(module.named_parameters()))
    if found is not None:
        raise diverged(f"What {folder} shall hold, the {kind},", "in its training", *found, OVERFLOW)
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
            another shape, or not sound.
    """
    folder = Path(folder)
    recover(folder)
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
            text = f"{folder}/config.json does not describe a {kind} ({error}): train it anew."
            raise UserError(text) from None

    found = _shapes(weights)
    with torch.device("meta"), _Outline(most_calls=CALLS_PER_TENSOR * len(found)):
        outline = build()
    _compare(outline, found, weights)
    with torch.random.fork_rng(devices=()):  # initial weights are drawn for nothing: whoever loads, keeps its own draws
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
        UserError: the file is missing, damaged, or holds other names or shapes than the module, or what no sound
            training leaves (see `unsound`).
    """
    path = Path(path)
    _compare(module, _shapes(path), path)
    tensors = load_file(path)
    module.load_state_dict(tensors)
    found = unsound(tensors, dict(module.named_parameters()))
    if found is not None:
        name, value = found
        raise UserError(f"{path} holds {value} in {name}: the training that wrote it diverged, so train it anew.")


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors in a safetensors file, from its header."""
    try:
        check_plain(path)
        with path.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
        if length > MOST_HEADER:  # the library would take a thousand million names
            raise SafetensorError(f"its header is of {length:,} bytes")
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
