"""Options that a published folder or a checkpoint brings along: data, held to our schema before a parser sees them."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from envtf_lit.agents.options import PolicyOptions
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.options.schema import build_section
from envtf_lit.pipeline.params import Params
from envtf_lit.world_models.options import TrainModelOptions

MODELS = {"environment_transformer": "model", "ensemble_dynamics": "ensemble"}  # kind to section of the options
PART = re.compile(r"[A-Za-z_]\w*(\.\w+)*", re.ASCII)  # of a module, as it can be frozen


def model_architecture(folder: str | Path) -> dict[str, Any]:
    """The options of `TrainModelOptions` that a published world model's weights ask for, as plain values.

    Empty where the folder's kind is no world model's, which is for the loader to refuse.

    Raises:
        UserError: no config.json, or arguments that are not options.
    """
    kind, arguments = _config(folder)
    if kind not in MODELS:
        return {}
    given = {name: value for name, value in arguments.items() if name not in ("observation_dim", "action_dim")}
    return _architecture(folder, TrainModelOptions, {MODELS[kind]: given})


def policy_architecture(folder: str | Path) -> dict[str, Any]:
    """The options of `PolicyOptions` that a published policy's weights ask for; otherwise as `model_architecture`."""
    _, arguments = _config(folder)
    return _architecture(folder, PolicyOptions, {name: arguments[name] for name in ("hidden",) if name in arguments})


def checkpoint_options(path: str | Path, cls: type[TrainModelOptions] | type[PolicyOptions]) -> dict[str, Any]:
    """The `options`, of this class, `seed` and frozen parts that a checkpoint was trained with, as plain values.

    Raises:
        UserError: the file is missing or is not such a checkpoint.
    """
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)["hyper_parameters"]
        return {
            "options": _plain(cls, saved["options"], "options"),
            "seed": build_section(Params, {"seed": saved["seed"]}, "").seed,
            "freeze": _parts(saved["freeze"]),
        }
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: give --ckpt_path a checkpoint of an earlier fit.") from None
    except UserError as error:
        reason = f" ({str(error).rstrip('.')})"
    except Exception:  # whatever unpickling raises; torch's own message recommends to run code found in the file
        reason = ""
    raise UserError(f"{path} is not a checkpoint of this model{reason}: give --ckpt_path a file that fit wrote.")


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
    return json.loads(json.dumps(asdict(build_section(cls, values, section))))  # tuples become lists


def _parts(freeze: Any) -> list[str]:
    if not isinstance(freeze, list) or not all(isinstance(part, str) and PART.fullmatch(part) for part in freeze):
        raise UserError(f"freeze is {freeze!r}, expected a list of names such as blocks.0.")
    return freeze
