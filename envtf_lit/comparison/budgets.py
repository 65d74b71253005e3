"""The budgets of a run: how long policies and world models are trained, on how much data, and how they are scored."""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from envtf_lit.data.loaders import UPDATES_PER_STEP
from envtf_lit.errors import UserError, did_you_mean

CURVE_EPISODES = 5  # of each evaluation along the way


@dataclass(frozen=True)
class Budget:
    """What a run may spend, the same for every algorithm, whatever number of updates was published for it.

    Its text, such as `cpu-small` or `cpu-small data_share=0.1`, names a budget of `BUDGETS` and what differs from it:
    rows of one text are comparable, and `read` makes the budget of it again.

    Attributes:
        name: in `BUDGETS`.
        updates: gradient steps of each policy.
        evaluations: along the way, at most; the last one falls on the last update.
        transitions: rows of the zoo's dataset.
        preset: whose world model, first rollouts and `policy:` section apply.
        model_updates: gradient steps of the transformer.
        ensemble_updates: of the ensemble at most; it stops early.
        paper_model: `et_cql_paper` imagines in the paper's own world model, that of the preset `paper`.
        episodes: of the evaluation at the end.
        data_share: of `transitions`, in (0, 1]: so many rows are collected, from each behaviour policy in proportion.
        data_seed: of the dataset and of the world models, which all training seeds share.
    """

    name: str
    updates: int
    evaluations: int
    transitions: int
    preset: str
    model_updates: int
    ensemble_updates: int
    paper_model: bool = False
    episodes: int = 20
    data_share: float = 1.0
    data_seed: int = 0

    def __str__(self) -> str:
        plain = BUDGETS[self.name]
        changed = [key for key in OVERRIDES if getattr(self, key) != getattr(plain, key)]
        return " ".join([self.name, *(f"{key}={getattr(self, key)}" for key in changed)])

    @property
    def rows(self) -> int:
        """Transitions of the dataset."""
        return round(self.transitions * self.data_share)

    @property
    def curve_episodes(self) -> int:
        """Of each evaluation along the way."""
        return min(CURVE_EPISODES, self.episodes)

    @property
    def updates_per_epoch(self) -> int:
        """Updates between two evaluations."""
        return epoch_of(self.updates, math.ceil(self.updates / self.evaluations), UPDATES_PER_STEP)


# cpu-small: the default preset's world model and data; an ensemble of as many updates, which its patience rarely needs.
# paper: a million updates (section V.A), and the size of most of D4RL's files.
BUDGETS = {
    budget.name: budget
    for budget in (
        Budget("cpu-small", 10_000, 20, 100_000, "small", 6_000, 6_000),
        Budget("cpu", 100_000, 50, 200_000, "small", 18_000, 30_000),
        Budget("gpu", 300_000, 60, 200_000, "base", 30_000, 100_000),
        Budget("paper", 1_000_000, 200, 1_000_000, "base", 100_000, 100_000, paper_model=True),
    )
}
OVERRIDES: dict[str, type[int] | type[float]] = dict(
    updates=int, episodes=int, transitions=int, model_updates=int, data_share=float, data_seed=int
)


def epoch_of(updates: int, least: int, multiple: int = 1) -> int:
    """The fewest updates, `least` or more, that are a multiple of some number and divide all updates into whole epochs.

    Raises:
        UserError: there are no such epochs.
    """
    if updates % multiple:
        raise UserError(f"--updates is {updates}: take a multiple of {multiple}.")
    begin = multiple * math.ceil(least / multiple)
    return next(epoch for epoch in range(begin, updates + 1, multiple) if updates % epoch == 0)


def budget_of(name: str, **changes: float | None) -> Budget:
    """A budget of `BUDGETS`, with some of the numbers in `OVERRIDES` changed; None leaves one as it is.

    Raises:
        UserError: no such budget, or a number that is out of range.
    """
    if name not in BUDGETS:
        raise UserError(f"Unknown budget {name!r}: {did_you_mean(name, BUDGETS)}")
    given: dict[str, Any] = {key: value for key, value in changes.items() if value is not None}
    for key, value in given.items():
        _check(key, value)
    if "model_updates" in given:
        given["ensemble_updates"] = given["model_updates"]
    budget = replace(BUDGETS[name], **given)
    epoch_of(budget.updates, 1, UPDATES_PER_STEP)
    return budget


def _check(key: str, value: float) -> None:
    flag, kind = f"--{key.replace('_', '-')}", OVERRIDES[key]
    if kind is float and not 0.0 < value <= 1.0:
        raise UserError(f"{flag} is {value:g}: give a number above 0, and at most 1.")
    if kind is int and (value != int(value) or value < (0 if key == "data_seed" else 1)):
        raise UserError(f"{flag} is {value:g}: give a whole number{'' if key == 'data_seed' else ' above 0'}.")


@cache
def read_budget(text: str) -> Budget:
    """The budget that a text names.

    Raises:
        UserError: it is not what `str` makes of a budget.
    """
    name, *changes = text.split(" ")
    pairs = [change.partition("=") for change in changes]
    try:
        budget = budget_of(name, **{key: OVERRIDES[key](value) for key, _, value in pairs})
    except (KeyError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{text!r} is no budget, such as 'cpu-small data_share=0.1'.") from None
    if str(budget) != text:
        raise UserError(f"The budget {text!r} would be written {str(budget)!r}.")
    return budget
