"""Options that a published folder or a checkpoint brings along: data, held to our schema before a parser sees them."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from envtf_lit.agents.options import PolicyOptions
from envtf_lit.errors import UserError
from envtf_lit.files import check_plain, read_json
from envtf_lit.options.schema import build
from envtf_lit.pipeline.params import Params
from envtf_lit.world_models.options import KINDS

PART = re.compile(r"[A-Za-z_]\w*(\.\w+)*", re.ASCII)  # of a module, as it can be frozen
ONLINE = "OnlineTransitions"  # under which Lightning keeps the state of the data module of that name
SAVED = {"environment_transformer": "transformer", "ensemble_dynamics": "ensemble"}  # kinds, as folders name them


def model_kind(folder: str | Path) -> str | None:
    """The kind of a published world model, or None where the folder holds none.

    Raises:
        UserError: no config.json.
    """
    return SAVED.get(_config(folder)[0])


def model_architecture(folder: str | Path) -> dict[str, Any]:
    """The options that a published world model's weights ask for, as plain values.

    Empty where the folder's kind is no world model's, which is for the loader to refuse.

    Raises:
        UserError: no config.json, or arguments that are not options.
    """
    kind, arguments = _config(folder)
    if kind not in SAVED:
        return {}
    given = {name: value for name, value in arguments.items() if name not in ("observation_dim", "action_dim")}
    if SAVED[kind] == "ensemble" and isinstance(given.get("hidden"), list):  # one for each layer, or it is refused
        given["weight_decay"] = [0.0] * (len(given["hidden"]) + 1)
    plain = _architecture(folder, KINDS[SAVED[kind]], given)
    plain.pop("weight_decay", None)
    return plain


def policy_architecture(folder: str | Path) -> dict[str, Any]:
    """The options of a policy that a published one's weights ask for; otherwise as `model_architecture`."""
    _, arguments = _config(folder)
    return _architecture(folder, PolicyOptions, {name: arguments[name] for name in ("hidden",) if name in arguments})


def checkpoint_options(path: str | Path, cls: type[Any]) -> dict[str, Any]:
    """The `options`, of this class, `seed` and frozen parts that a checkpoint was trained with, as plain values.

    Raises:
        UserError: the file is missing or is not such a checkpoint.
    """
    try:
        saved = _hyper_parameters(path)
        return {
            "options": _plain(cls, saved["options"], "options"),
            "seed": build(Params, {"seed": saved["seed"]}, "").seed,
            "freeze": _parts(saved["freeze"]),
        }
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: give --ckpt_path a checkpoint of an earlier fit.") from None
    except UserError as error:
        reason = f" ({str(error).rstrip('.')})"
    except Exception:  # whatever unpickling raises; torch's own message recommends to run code found in the file
        reason = ""
    raise UserError(f"{path} is not a checkpoint of this model{reason}: give --ckpt_path a file that fit wrote.")


def checkpoint_class(path: str | Path, classes: Mapping[str, type]) -> str | None:
    """The name of the class whose options a checkpoint has; None where there is none, which `checkpoint_options` says.

    Args:
        path: of a checkpoint.
        classes: of options, by name.
    """
    try:
        names = set(_hyper_parameters(path)["options"])
    except Exception:  # whatever unpickling raises
        return None
    return next((name for name, cls in classes.items() if {field.name for field in fields(cls)} == names), None)


def learned_online(path: str | Path) -> bool:
    """Whether a checkpoint holds an `OnlineData`'s state; of what is no checkpoint others tell."""
    try:
        return ONLINE in _checkpoint(path)
    except Exception:  # whatever unpickling raises
        return False


def _hyper_parameters(path: str | Path) -> dict[str, Any]:
    return _checkpoint(path)["hyper_parameters"]


def _checkpoint(path: str | Path) -> dict[str, Any]:
    check_plain(path)
    return torch.load(path, map_location="cpu", weights_only=True, mmap=True)  # no weights read


def _config(folder: str | Path) -> tuple[str, Mapping[str, Any]]:
    """Kind and constructor's arguments in a published folder's config.json, none where it has another form."""
    config = read_json(Path(folder) / "config.json")
    config = config if isinstance(config, dict) else {}
    arguments = config.get("arguments")
    return str(config.get("kind")), arguments if isinstance(arguments, dict) else {}


def _architecture(folder: str | Path, cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    try:
        plain = _plain(cls, values, "arguments")
    except UserError as error:
        raise UserError(f"{folder}/config.json: {str(error).rstrip('.')}; save the model anew.") from None
    return {name: plain[name] for name in values}


def _plain(cls: type, values: Any, section: str) -> dict[str, Any]:
    """Nested dictionaries, lists, numbers and strings of an options class, and nothing else."""
    return json.loads(json.dumps(asdict(build(cls, values, section))))  # tuples become lists


def _parts(freeze: Any) -> list[str]:
    if not isinstance(freeze, list) or not all(isinstance(part, str) and PART.fullmatch(part) for part in freeze):
        raise UserError(f"freeze is {freeze!r}, expected a list of names such as blocks.0.")
    return freeze
