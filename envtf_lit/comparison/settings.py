"""What a run of the grid is trained with: the options of its policy and of the world model that it imagines in."""

from dataclasses import asdict
from functools import cache
from typing import Any

from envtf_lit.agents.options import NO_WORLD_MODEL, PolicyOptions
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.comparison.budgets import Budget, epoch_of
from envtf_lit.comparison.grid import Cell
from envtf_lit.data.loaders import UPDATES_PER_STEP
from envtf_lit.options.schema import build
from envtf_lit.pipeline.params import Params, build_params
from envtf_lit.pipeline.published import published_options
from envtf_lit.pipeline.yaml import dump_params, preset_params

CLONE = "clone"  # the section of the policy that acts in the first rollouts
PAPER_MODEL = "paper"  # the section of the paper's own world model, and its preset
LATEST = 3  # each phase at the end that is counted in updates takes at most one in so many of all


@cache
def _preset(name: str) -> Params:
    return preset_params(name)


def policy_options(cell: Cell) -> PolicyOptions:
    """The policy's options: of its kit, fitted to the budget.

    What was published as a number of updates before the algorithm's own, such as RAMBO's cloning, keeps its share of
    them; the phases that end `et_cql` keep their numbers, as far as a third of the budget holds each.

    Raises:
        UserError: nothing was published for the task.
    """
    budget, cls = cell.budget, ALGORITHMS[cell.algorithm].Options
    if cell.kit == "published":
        options = published_options(cell.algorithm, cell.task)
    else:
        options = cls(**asdict(_preset(budget.preset).policy))
    values: dict[str, Any] = asdict(options) | {
        "updates": budget.updates,
        "updates_per_epoch": budget.updates_per_epoch,
    }
    if options.warm_start >= 1.0:
        values["warm_start"] = options.warm_start / options.updates
    most = max(1, budget.updates // LATEST)
    if "critic_updates" in values:
        values["critic_updates"] = min(values["critic_updates"], most)
    if "value_gradient" in values:
        values["value_gradient"] |= {"updates": min(values["value_gradient"]["updates"], most)}
    if values["world_model"] != NO_WORLD_MODEL and cell.algorithm == "et_cql_paper" and budget.paper_model:
        paper = _preset(PAPER_MODEL).generate_rollouts
        values["world_model"] = PAPER_MODEL
        values["rollouts"] |= {"branches": paper.branches, "history": paper.history}
    return build(cls, values, f"{cell.algorithm} ({cell.kit})")


def shared_params(task: str, budget: Budget, model: str = "transformer") -> Params:
    """The stages' options for what the runs of a task share: dataset, clone, a world model, its first rollouts.

    Args:
        task: robot and tier.
        budget: of the runs.
        model: `transformer`, `ensemble`, or `paper`.
    """
    tree = dump_params(_preset(PAPER_MODEL if model == PAPER_MODEL else budget.preset))
    clone = dump_params(_preset(budget.preset))["train_policy"]["bc"]
    updates = min(budget.updates, _preset("small").policy.updates)
    clone |= {"updates": updates, "updates_per_epoch": epoch_of(updates, min(updates, 500), UPDATES_PER_STEP)}
    tree["generate_rollouts"]["policy"] = CLONE
    tree["evaluate"]["world_model"] = model
    return build_params(
        tree
        | {"task": task, "seed": budget.data_seed, "threads": 1, "compile": False}
        | {"download": tree["download"] | {"transitions": budget.rows}}
        | {"train_model": {model: _model(model, tree, budget)}, "train_policy": {CLONE: clone}}
    )


def _model(name: str, tree: dict[str, Any], budget: Budget) -> dict[str, Any]:
    """The section of a world model."""
    if name == "ensemble":
        updates, least = budget.ensemble_updates, 500
        return {"kind": name, "updates": updates, "updates_per_epoch": epoch_of(updates, min(updates, least))}
    section, updates = dict(tree["train_model"]["transformer"]), budget.model_updates
    least = min(updates, section["updates_per_epoch"])
    return section | {"updates": updates, "updates_per_epoch": epoch_of(updates, least)}


def cell_params(cell: Cell, name: str) -> Params:
    """All options of the stage that trains a run's policy, one thread.

    Args:
        cell: the run.
        name: of its section below `train_policy`.

    Raises:
        UserError: the policy's options do not go with the world model's.
    """
    options = policy_options(cell)
    alone = options.world_model == NO_WORLD_MODEL
    tree = dump_params(shared_params(cell.task, cell.budget, *([] if alone else [options.world_model])))
    tree["train_policy"][name] = {"algorithm": cell.algorithm} | asdict(options)
    return build_params(tree | {"seed": cell.seed})
