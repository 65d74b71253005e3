"""What the paper claims of its policies, held against the runs of one kit: reproduced, contradicted, or open, and why.

A verdict is on the direction of a claim. Its numbers are of other data, another simulator and a million updates.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.comparison.findings import Standing, first_alone, model_of
from envtf_lit.comparison.grid import KITS
from envtf_lit.comparison.references import TASK_SETS
from envtf_lit.comparison.statistics import Estimate, mean_over_seeds
from envtf_lit.comparison.view import View, label_of

Verdict = Literal["reproduces", "does not", "open"]

CLAIMANT = {"published": "et_cql_paper", "same": "et_cql"}  # whose runs stand for the paper's method, by kit
FIRST = 9  # tasks of the twenty on which the paper's method has the highest score


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and what some runs say of it.

    Attributes:
        said: by the paper.
        found: in the runs.
        verdict: on the claim's direction.
        why: the verdict is no other.
    """

    said: str
    found: str
    verdict: Verdict
    why: str


def claims(view: View, standings: Mapping[str, Standing]) -> list[Claim]:
    """Every claim that runs of policies can be held against, in the paper's order.

    Args:
        view: runs of one kit.
        standings: of its algorithms (see `findings.standings`).
    """
    name = CLAIMANT[view.kit]
    return [
        _ahead(view, standings, name),
        _first_on_ant(view, name),
        _firsts(view, name),
        _fastest(view, standings, name),
        _cheaper(standings, name),
    ]


def by_interval(difference: Estimate) -> tuple[Verdict, str]:
    """What a difference says of `higher`, by its interval."""
    if difference.low is None or difference.high is None:
        return "open", "there is no interval: one seed alone, or one task"
    if difference.low > 0.0:
        return "reproduces", "the interval lies above zero"
    return (
        ("does not", "the interval lies below zero") if difference.high < 0.0 else ("open", "the interval holds zero")
    )


def _ahead(view: View, standings: Mapping[str, Standing], name: str) -> Claim:
    said = "Imagination is worth it: a higher mean than CQL's."
    if name not in standings or "cql" not in standings[name].difference:
        return Claim(said, "–", "open", f"no task has runs of both {label_of(name)} and CQL")
    over = standings[name].difference["cql"].over_tasks
    verdict, why = by_interval(over)
    width = "" if over.high is None else f" ± {over.high - over.value:.1f}"
    return Claim(said, f"{over.value:+.1f}{width} over {over.count} tasks", verdict, why)


def _first_on_ant(view: View, name: str) -> Claim:
    """On each Ant task, against whoever else is best there."""
    said = "First on all five Ant datasets, by a margin."
    there = [task for task in view.shared_by(_with(view, name)) if task.startswith("ant-")]
    if name not in view.algorithms or len(view.compared) < 2 or not there:
        return Claim(said, "–", "open", f"no Ant task has runs of {label_of(name)} and of all others")
    leads = [_lead(view, name, task) for task in there]
    above = sum(lead.value > 0.0 for lead in leads)
    verdicts = [by_interval(lead)[0] for lead in leads]
    found = f"ahead on {above} of {len(there)}"
    if "does not" in verdicts:
        return Claim(said, found, "does not", "the whole interval of the lead lies below zero on at least one")
    if verdicts.count("reproduces") == len(_ant()):
        return Claim(said, found, "reproduces", "the whole interval of the lead lies above zero on each")
    behind = f"behind on {len(there) - above}, within what seeds may do" if above < len(there) else ""
    few = f"{len(there)} of {len(_ant())} tasks" if len(there) < len(_ant()) else ""
    alone = "too few seeds for a clear lead" if verdicts.count("reproduces") < len(there) else ""
    return Claim(said, found, "open", "; ".join(filter(None, (behind, few, alone))))


def _lead(view: View, name: str, task: str) -> Estimate:
    """By how much an algorithm is above the best of the others on a task, seed by seed."""
    cells = {task: view.shared_by(_with(view, name))[task]}
    scores = {other: view.samples(other, cells)[0] for other in _with(view, name)}
    own = scores.pop(name)
    return mean_over_seeds(own - max(scores.values(), key=lambda found: float(found.mean())))


def _with(view: View, name: str) -> list[str]:
    return list(dict.fromkeys([*view.compared, name]))


def _ant() -> list[str]:
    return [task for task in TASK_SETS["20 tasks"] if task.startswith("ant-")]


def _firsts(view: View, name: str) -> Claim:
    """However the tasks that are not there come out, the count ends between what it is and that many more."""
    planned = len(TASK_SETS["20 tasks"])
    said = f"The highest score on {FIRST} of {planned} tasks, among six."
    if name not in view.compared or len(view.compared) < 2:
        return Claim(said, "–", "open", f"no task has runs of {label_of(name)} and of all others")
    seen, first = len(view.common), first_alone(view).count(name)
    found = f"on {first} of {seen}, among {len(view.compared)}"
    if len(view.compared) < len(KITS[view.kit].algorithms):
        lacking = len(KITS[view.kit].algorithms) - len(view.compared)
        return Claim(said, found, "open", f"{lacking} of the kit's algorithms have too few runs")
    if first >= FIRST:
        return Claim(said, found, "reproduces", "as many, by the means over seeds")
    left = planned - seen
    if first + left < FIRST:
        return Claim(said, found, "does not", f"it could be at most {first + left} with the tasks that are missing")
    return Claim(said, found, "open", f"{left} tasks are missing")


def _fastest(view: View, standings: Mapping[str, Standing], name: str) -> Claim:
    said = "It learns fastest of those with a world model."
    some = {run.algorithm: run for run in view.runs}
    known = {
        other: standing.reached
        for other, standing in standings.items()
        if standing.reached is not None and model_of(some[other]) not in (None, NO_WORLD_MODEL)
    }
    if name not in known or len(known) < 2:
        return Claim(said, "–", "open", "no runs of a second algorithm with a world model")
    own = known.pop(name)
    best = min(known, key=lambda other: known[other])
    found = f"90 % of its score after {own:.0%} of the updates; {label_of(best)} after {known[best]:.0%}"
    return Claim(said, found, "reproduces" if own < known[best] else "does not", "medians over runs, without interval")


def _cheaper(standings: Mapping[str, Standing], name: str) -> Claim:
    said = "Its model costs less to train than an ensemble."
    times = {other: s.model_seconds for other, s in standings.items() if s.model_seconds is not None}
    others: Iterator[float] = (seconds for other, seconds in times.items() if other not in CLAIMANT.values())
    ensemble = max(others, default=None)
    if name not in times or ensemble is None:
        return Claim(said, "–", "open", "no runs of both kinds of model, with their seconds")
    found = f"{times[name]:,.0f} s against {ensemble:,.0f} s"
    return Claim(said, found, "reproduces" if times[name] < ensemble else "does not", "medians over tasks")
