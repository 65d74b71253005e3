"""Writes what results say: a page in Markdown, figures with their numbers, and a summary in JSON."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.comparison import page
from envtf_lit.comparison.budgets import read_budget
from envtf_lit.comparison.claims import claims
from envtf_lit.comparison.findings import Log, Standing, early, harm, logs, missing, standings
from envtf_lit.comparison.grid import KITS
from envtf_lit.comparison.records import CURVES, SHARED, Evaluation, Run, Shared, read_records
from envtf_lit.comparison.references import OURS, Column
from envtf_lit.comparison.statistics import RESAMPLES, SEED
from envtf_lit.comparison.view import View, label_of, with_data
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.figures.comparison import learning_curves, score_intervals
from envtf_lit.figures.style import policy_colours
from envtf_lit.files import write_json, write_text
from envtf_lit.results import claim
from envtf_lit.robots.tasks import ROBOTS, TIERS

OUT, PAGE, SUMMARY = Path("reports/comparison"), "index.md", "summary.json"
FIGURES = ("curves", "scores")  # each with the kit's name behind it
MARK = "comparison.budget"


def report(results: Path, out: Path = OUT, *, budget: str | None = None) -> dict[str, Any]:
    """Writes page, figures and summary of a comparison into a folder; a part of the grid is enough.

    Args:
        results: CSV file of the runs; the curves and what the runs share lie beside it.
        out: folder; an earlier report there is replaced.
        budget: its text, such as `cpu-small`; None for that of most runs.

    Returns:
        What the summary holds: flat keys, `KIT.ALGORITHM.` before each number.

    Raises:
        UserError: there are no runs, a file is damaged, or something else lies where the report shall.
    """
    runs = read_records(results, Run)
    if not runs:
        raise UserError(f"{results} has no runs: make some with `envtf compare run`.")
    budget = chosen_budget(runs, budget)
    curves, shared = (
        read_records(results.with_name(CURVES), Evaluation),
        read_records(results.with_name(SHARED), Shared),
    )
    views = {kit: view for kit in KITS if (view := View.of(runs, kit, budget)).runs}
    pictures = [out / f"{name}_{kit}{ending}" for name in FIGURES for kit in KITS for ending in (".png", ".csv")]
    claim(out / SUMMARY, MARK, [out / PAGE, *pictures])
    known = logs(shared, budget)
    found = {kit: standings(view, curves, shared) for kit, view in views.items()}
    parts = [_head(budget, runs)]
    for kit, view in views.items():
        _draw(view, curves, known, found[kit], out)
        parts += _kit(view, found[kit], known, runs)
    write_text(out / PAGE, "\n\n".join([*parts, *_published(views.values())]) + "\n")
    content = {MARK: budget, "comparison.runs": sum(len(view.runs) for view in views.values())}
    for kit, view in views.items():
        content |= _numbers(kit, found[kit]) | {f"{kit}.harmful": len(harm(view, known)[0])}
    write_json(out / SUMMARY, content)
    return content


def chosen_budget(runs: Sequence[Run], budget: str | None) -> str:
    """The budget to be reported.

    Raises:
        UserError: there are no runs of the one that is asked for.
    """
    counts = pd.Series([run.budget for run in runs]).value_counts()
    if budget is not None and budget not in counts:
        raise UserError(f"There are no runs of the budget {budget!r}: {did_you_mean(budget, counts.index)}")
    return budget or str(counts.index[0])


def _head(budget: str, runs: Sequence[Run]) -> str:
    b = read_budget(budget)
    commits = sorted({run.commit for run in runs if run.budget == budget})
    several = f" **The runs are of {len(commits)} versions of the code: {', '.join(commits)}.**" if commits[1:] else ""
    return (
        f"# Comparison: {budget}\n\n"
        f"{b.updates:,} updates of every algorithm, {b.rows:,} transitions of the zoo's datasets (data seed "
        f"{b.data_seed}), {b.episodes} MuJoCo episodes at the end, {b.curve_episodes} at each evaluation along the "
        "way. Scores are D4RL-normalised; behind `±` stands half of a 95 % interval over training seeds (Student's), "
        f"then their number. IQM and P(higher) have percentiles of {RESAMPLES:,} stratified bootstrap resamples (seed "
        f"{SEED}), over the runs that all compared algorithms have.{several}"
    )


TITLES = {"published": "As published", "same": "Same kit"}


def _kit(view: View, found: Mapping[str, Standing], known: Mapping[str, Log], runs: Sequence[Run]) -> list[str]:
    """The parts on one kit."""
    meaning = KITS[view.kit].meaning
    lacked = missing(view, read_budget(view.budget))
    evaluated = any(standing.reached is not None for standing in found.values())  # along the way: there are curves
    return [
        f"## {TITLES[view.kit]}",
        f"{meaning[0].upper()}{meaning[1:]}. {page.weighted_bc_note(view)}",
        *_scores(view, found, known),
        "Run by run against CQL and weighted BC, with the same data, training seed and evaluation episodes; the "
        "interval over seeds is of these tasks, the one over tasks of others like them, too (Student's):",
        page.pairs(found),
        "**What the paper claims.** " + page.claims(claims(view, found)),
        "**No harm.** " + page.no_harm(*harm(view, known)),
        *page.diverged(early(view)),
        *([f"![Learning curves, a panel per task](curves_{view.kit}.png)"] if evaluated else []),
        "Median share of the updates after which an evaluation first had 90 % of the final score; median seconds of "
        "training, without evaluations and world model; the most memory of a run's process:",
        page.costs(found),
        *_data_shares(view, runs),
        "**Missing.** " + page.lacking(lacked, len(lacked) + len(view.runs)),
    ]


def _scores(view: View, found: Mapping[str, Standing], known: Mapping[str, Log]) -> list[str]:
    left_out = [label_of(name) for name in view.algorithms if name not in view.compared]
    return [
        "Final scores, the highest of a task in bold:",
        page.headline(view, known, "score_final"),
        "Means of the last ten evaluations along the way:",
        page.headline(view, known, "score_last10"),
        f"Over the {len(view.common)} tasks, and their seeds, that all compared algorithms have. The best checkpoint "
        "is chosen in the simulator, which nobody has who learns from a log:"
        + (f" (Too few runs to be compared: {', '.join(left_out)}.)" if left_out else ""),
        page.summary(view, found),
        *([f"![Interquartile means with intervals](scores_{view.kit}.png)"] if view.common else []),
    ]


def _data_shares(view: View, runs: Sequence[Run]) -> list[str]:
    """The part on less data, where there are runs of it."""
    by_text = {text: View.of(runs, view.kit, text) for text in with_data(view.budget, runs)}
    views = {f"{100 * read_budget(text).data_share:g} %": other for text, other in by_text.items() if other.runs}
    table = page.data_shares(views, view.algorithms)
    return [] if table is None else ["Mean final scores by the share of the data:", table]


# whose columns stand beside the paper's, by kit
BESIDE = {"published": ("et_cql_paper", "mopo", "rambo", "combo", "cql", "iql"), "same": ("et_cql",)}


def own_columns(view: View, names: Sequence[str]) -> list[Column]:
    """Our own scores as the published ones are kept, a column for each of these algorithms that has runs."""
    return [
        Column(
            label_of(name),
            f"ours, {view.kit}",
            OURS,
            f"final, {view.budget}",
            {task: float(view.scores(name, task).mean()) for task in view.tasks if view.seeds(name, task)},
        )
        for name in names
        if name in view.algorithms
    ]


def _published(views: Iterable[View]) -> list[str]:
    """The part on published scores."""
    views = list(views)
    return [
        "## Beside published scores",
        "Published scores are of D4RL's files (`-v2`; the paper's CQL column has those of `-v0`) and older simulators; "
        f"ours are of other data and Gymnasium's -v5 ({OURS}): they stand beside each other, and differences between "
        "the two mean little. A column's mean is given over the sets of tasks that it has whole, since averages over "
        "different sets, as in the paper's last row, do not compare.",
        page.paper_table([column for view in views for column in own_columns(view, BESIDE[view.kit])]),
        "Everybody who has such a set whole:",
        page.peers_table([column for view in views for column in own_columns(view, view.algorithms)]),
        page.sweeps(),
    ]


def _draw(
    view: View, curves: Sequence[Evaluation], known: Mapping[str, Log], found: Mapping[str, Standing], out: Path
) -> None:
    """The kit's figures; each is left out where there is nothing to show."""
    colours = policy_colours(label_of(name) for name in reversed(view.algorithms))  # the last, ours, has the first
    table = curve_table(view, curves)
    if len(table):
        levels, title = (
            {task: (log.mean, log.best) for task, log in known.items()},
            f"Scores along the way ({view.kit})",
        )
        learning_curves(table, levels, out / f"curves_{view.kit}.png", colours=colours, title=title)
    points = [(label_of(name), s.iqm.value, s.iqm.low, s.iqm.high) for name, s in found.items() if s.iqm is not None]
    if points:
        title = "Interquartile mean of the final scores"
        score_intervals(points, out / f"scores_{view.kit}.png", colours=colours, title=title)


def curve_table(view: View, curves: Sequence[Evaluation]) -> pd.DataFrame:
    """The evaluations of the kit's runs, robots, tiers and algorithms in their usual order."""
    there = {run.run for run in view.runs}
    places = {name: place for names in (ROBOTS, TIERS, view.algorithms) for place, name in enumerate(names)}
    points = [point for point in curves if point.run in there]
    points.sort(key=lambda p: (places[p.robot], places[p.tier], places[p.algorithm], p.seed, p.updates))
    rows = [(p.robot, p.tier, label_of(p.algorithm), p.seed, p.updates, p.score) for p in points]
    return pd.DataFrame(rows, columns=["robot", "tier", "algorithm", "seed", "updates", "score"])


def _numbers(kit: str, found: Mapping[str, Standing]) -> dict[str, Any]:
    """The summary's keys of one kit."""
    numbers = dict[str, Any]()
    for name, standing in found.items():
        key = f"{kit}.{name}"
        numbers |= {f"{key}.runs": standing.runs, f"{key}.first_alone": standing.first_alone}
        numbers |= {f"{key}.mean": standing.mean, f"{key}.worst": standing.worst.score_final}
        numbers |= {f"{key}.above_log": standing.above_log[0], f"{key}.seconds": standing.seconds}
        if standing.iqm is not None:
            numbers |= {f"{key}.iqm": standing.iqm.value, f"{key}.iqm_interval": [standing.iqm.low, standing.iqm.high]}
        for base, difference in standing.difference.items():
            over = difference.over_seeds
            numbers |= {f"{key}.over_{base}": over.value, f"{key}.over_{base}_interval": [over.low, over.high]}
    return numbers
