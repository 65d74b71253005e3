"""Published settings of each algorithm, a row per task (`configs/algorithms/`), and params.yaml made of a row."""

from dataclasses import asdict
from functools import cache
from importlib import resources
from typing import Any

from ruamel.yaml import YAML

from envtf_lit.agents.options import NO_WORLD_MODEL, PolicyOptions
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.options.schema import build
from envtf_lit.pipeline.params import Params, build_params
from envtf_lit.pipeline.yaml import dump_params, preset_params

ORIGINS = ("paper", "kit", "corl", "harness", "ours")  # of a row's values; the head of each file says which is meant


def published_rows(algorithm: str) -> dict[str, dict[str, Any]]:
    """Options of each task, `origin` among them: whose they are.

    Raises:
        UserError: no such algorithm.
    """
    if algorithm not in ALGORITHMS:
        raise UserError(f"Unknown algorithm {algorithm!r}: {did_you_mean(algorithm, ALGORITHMS)}")
    file = _file(algorithm)
    return {task: file["common"] | row for task, row in file["tasks"].items()}


@cache
def _file(algorithm: str) -> dict[str, Any]:
    text = resources.files("envtf_lit").joinpath(f"configs/algorithms/{algorithm}.yaml").read_text()
    return YAML(typ="safe", pure=True).load(text)


def published_options(algorithm: str, task: str) -> PolicyOptions:
    """The options of one task, checked.

    Raises:
        UserError: no such algorithm, or no row for the task.
    """
    rows = published_rows(algorithm)
    if task not in rows:
        raise UserError(f"There are no settings of {algorithm} for {task!r}: {did_you_mean(task, rows)}")
    values = {name: value for name, value in rows[task].items() if name != "origin"}
    return build(ALGORITHMS[algorithm].Options, values, task)


def published_params(algorithm: str, task: str | None = None, preset: str = "small") -> Params:
    """All of params.yaml, such that the stages train an algorithm as published.

    The preset has the last word on what is not the policy's: the dataset's size, the world model's, the evaluation. A
    cloned policy stands beside an algorithm that imagines, for the first rollouts.

    Args:
        algorithm: by name.
        task: robot and tier; None for the preset's.
        preset: beneath.

    Raises:
        UserError: no such algorithm, preset, or row for the task.
    """
    tree = dump_params(preset_params(preset))
    task = str(task or tree["task"])
    options = published_options(algorithm, task)
    cloned = {"bc": tree["train_policy"]["bc"]}
    tree["train_policy"] = cloned | {algorithm: {"algorithm": algorithm} | asdict(options)}
    model = options.world_model
    if model != NO_WORLD_MODEL:
        tree["train_model"] = {model: tree["train_model"].get(model, {"kind": model})}
        tree["evaluate"]["world_model"] = model
    return build_params(tree | {"task": task})
