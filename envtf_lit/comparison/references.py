"""Published scores: the paper's table and its peers', each with its data and version; means over equal sets of tasks.

They are of D4RL's own files and older simulators. Ours are of the zoo's data and Gymnasium's -v5, so that the two stand
beside each other and are not subtracted.
"""

import csv
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

from envtf_lit.robots.tasks import ROBOTS, TIERS

PAPER = "Environment Transformer paper"  # the publisher of the table that ours stands beside
OURS = "zoo, -v5"  # the data of our own scores

_LOCOMOTION = ("hopper", "halfcheetah", "walker2d")
_THREE = ("medium", "medium-replay", "medium-expert")
# sets of tasks that publishers have, the smallest first: most have no Ant, many no random or full-replay
TASK_SETS: dict[str, tuple[str, ...]] = {
    f"{len(robots) * len(tiers)} tasks": tuple(f"{robot}-{tier}" for robot in robots for tier in tiers)
    for robots, tiers in (
        (_LOCOMOTION, _THREE),
        (_LOCOMOTION, ("random", *_THREE)),
        (_LOCOMOTION, TIERS),
        (tuple(ROBOTS), TIERS),
    )
}
# The last row of the paper's table. It averages each column over the tasks that it has: 20, 12 or 9 of them.
PRINTED_AVERAGES = {"ET": 78.8, "MOPO": 40.5, "RAMBO": 69.8, "COMBO": 64.1, "CQL": 54.9, "IQL": 77.0}
# Mean score of a random configuration and of the best one for each task, in ReBRAC's own sweeps over 15 tasks (Tarasov
# et al. 2023, eop/bin/profiles_data.pickle of DT6A/ReBRAC): what one configuration for all tasks is to be held against.
SWEEPS = {"ReBRAC": (58.9, 78.2), "IQL": (58.0, 71.4), "TD3+BC": (46.5, 69.8)}


@dataclass(frozen=True)
class Column:
    """The scores of an algorithm that one publisher has.

    Attributes:
        algorithm: as they call it; `ET` is the Environment Transformer.
        publisher: paper or repository.
        data: whose files, and their version.
        measure: which score of a run it is.
        scores: by task.
    """

    algorithm: str
    publisher: str
    data: str
    measure: str
    scores: Mapping[str, float]


@cache
def published_columns() -> tuple[Column, ...]:
    """All that we know of, in the order of the file, which names the source of every score."""
    text = resources.files("envtf_lit").joinpath("assets/published_scores.csv").read_text("utf-8")
    found = dict[tuple[str, str, str, str], dict[str, float]]()
    for row in csv.DictReader(text.splitlines()):
        name = (row["algorithm"], row["publisher"], row["data"], row["measure"])
        found.setdefault(name, {})[f"{row['robot']}-{row['tier']}"] = float(row["score"])
    return tuple(Column(*name, scores=scores) for name, scores in found.items())


def mean_over(scores: Mapping[str, float], tasks: Collection[str]) -> float | None:
    """The mean over a set of tasks, or None where one is missing: averages over different sets do not compare."""
    return sum(scores[task] for task in tasks) / len(tasks) if set(tasks) <= scores.keys() else None
