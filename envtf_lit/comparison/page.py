"""The comparison's page in Markdown, part by part."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean

from envtf_lit.comparison.claims import Claim
from envtf_lit.comparison.findings import BASES, Harm, Log, Standing
from envtf_lit.comparison.grid import WEIGHTED_BC, Cell
from envtf_lit.comparison.records import Run
from envtf_lit.comparison.references import PAPER, SWEEPS, TASK_SETS, Column, mean_over, published_columns
from envtf_lit.comparison.statistics import Estimate, mean_over_seeds
from envtf_lit.comparison.view import View, label_of
from envtf_lit.data.cards import markdown_table

NONE = "–"


def number(value: float | None, digits: int = 1) -> str:
    """A number, or a dash; no minus before a zero."""
    return NONE if value is None else f"{round(value, digits) + 0.0:,.{digits}f}"


def spread(estimate: Estimate | None) -> str:
    """`59.1 ± 4.9 (3)`: a mean, half its interval's width, and the number of seeds; `59.1 (1)` where there is none."""
    if estimate is None:
        return NONE
    width = "" if estimate.high is None else f" ± {number(estimate.high - estimate.value)}"
    return f"{number(estimate.value)}{width} ({estimate.count})"


def interval(estimate: Estimate | None, digits: int = 1) -> str:
    """`59.1 [54.0, 63.2]`; without brackets where there is no interval."""
    if estimate is None or estimate.low is None:
        return number(estimate and estimate.value, digits)
    return f"{number(estimate.value, digits)} [{number(estimate.low, digits)}, {number(estimate.high, digits)}]"


def headline(view: View, known: Mapping[str, Log], column: str) -> str:
    """Tasks by algorithms: mean over seeds, interval and number of seeds; beside them what the log itself scores.

    Args:
        view: runs of one kit.
        known: the logs, by task.
        column: of the runs, such as `score_final`.
    """
    names = view.algorithms
    rows = [[task, *_bold(view, task, column), *_log(known.get(task))] for task in view.tasks]
    means = [_over_common(view, name, column) for name in names]
    rows.append([f"mean over {len(view.common)} common", *map(number, means), "", ""])
    return markdown_table(["task", *map(label_of, names), "data, mean", "data, best"], rows)


def _bold(view: View, task: str, column: str) -> Iterator[str]:
    """The cells of a task, the highest in bold if it is alone."""
    found = {
        name: mean_over_seeds(view.scores(name, task, column)) for name in view.algorithms if view.seeds(name, task)
    }
    means = {name: round(estimate.value, 1) for name, estimate in found.items()}
    first = [name for name in means if means[name] == max(means.values())]
    for name in view.algorithms:
        text = spread(found.get(name))
        yield f"**{text}**" if first == [name] and len(found) > 1 else text


def _log(log: Log | None) -> tuple[str, str]:
    return (NONE, NONE) if log is None else (number(log.mean), number(log.best))


def _over_common(view: View, name: str, column: str) -> float | None:
    if name not in view.compared or not view.common:
        return None
    return fmean(float(scores.mean()) for scores in view.samples(name, view.common, column))


def summary(view: View, found: Mapping[str, Standing]) -> str:
    """A row for each algorithm: IQM, the worst run, how often first or above the log; best checkpoints at the side."""
    head = ["", "runs", "IQM, final", "IQM, last ten", "mean", "worst run", "first alone", "above the best episode"]
    rows = [
        [
            label_of(name),
            standing.runs,
            interval(standing.iqm),
            interval(standing.iqm_last10),
            number(standing.mean),
            f"{number(standing.worst.score_final)} ({_where(standing.worst)})",
            standing.first_alone,
            f"{standing.above_log[0]} of {standing.above_log[1]}",
            number(standing.best),
        ]
        for name, standing in found.items()
    ]
    return markdown_table([*head, "*best checkpoint, mean*"], rows)


def _where(run: Run) -> str:
    return f"{run.robot}-{run.tier}, seed {run.seed}"


def pairs(found: Mapping[str, Standing]) -> str:
    """Each algorithm against CQL and weighted BC: chance to score higher, and paired difference."""
    head = ["against", "", "P(higher)", "difference, over seeds", "difference, over tasks", "pairs"]
    rows = [
        [
            label_of(base),
            label_of(name),
            interval(standing.improvement[base], 2),
            interval(standing.difference[base].over_seeds),
            interval(standing.difference[base].over_tasks),
            standing.difference[base].over_seeds.count,
        ]
        for base in BASES
        for name, standing in found.items()
        if base in standing.difference
    ]
    return markdown_table(head, rows)


def claims(found: Iterable[Claim]) -> str:
    """What the paper says, what these runs say of it, the verdict and its reason; the counts before it."""
    found = list(found)
    count = Counter(claim.verdict for claim in found)
    line = f"{count['reproduces']} of {len(found)} reproduce, {count['does not']} do not, {count['open']} are open."
    rows = [[claim.said, claim.found, f"**{claim.verdict}**", claim.why] for claim in found]
    return f"{line}\n\n{markdown_table(['the paper', 'these runs', 'verdict', 'why'], rows)}"


def costs(found: Mapping[str, Standing]) -> str:
    """Updates to 90 % of the final score, seconds and memory of each algorithm."""
    head = ["", "updates to 90 %", "seconds", "world model, seconds", "memory, MB"]
    rows = [
        [
            label_of(name),
            NONE if standing.reached is None else f"{100 * standing.reached:.0f} %",
            number(standing.seconds, 0),
            number(standing.model_seconds, 0),
            number(standing.memory_mb, 0),
        ]
        for name, standing in found.items()
    ]
    return markdown_table(head, rows)


def no_harm(harmful: Sequence[Harm], judged: int) -> str:
    """The runs that do worse than weighted BC or the log."""
    line = (
        f"{len(harmful)} of {judged} runs score below 90 % of weighted BC or of the data's mean episode, whichever is "
        "larger."
    )
    rows = [
        [label_of(harm.run.algorithm), _where(harm.run), number(harm.run.score_final), number(harm.yardstick)]
        for harm in harmful
    ]
    return f"{line}\n\n{markdown_table(['', 'task', 'score', 'yardstick'], rows)}" if rows else line


def diverged(runs: Sequence[Run]) -> list[str]:
    """The runs whose training diverged; nothing where none has."""
    lines = [f"- {label_of(run.algorithm)}, {_where(run)}: after {run.updates:,} updates" for run in runs]
    return (
        ["**Diverged.** Scored is the last sound policy that was scored on the way:", "\n".join(lines)] if lines else []
    )


def data_shares(views: Mapping[str, View], algorithms: Sequence[str]) -> str | None:
    """Mean scores by share of the data, over the tasks and seeds that an algorithm has with all of its shares.

    Args:
        views: by what the share is called, the smallest first.
        algorithms: to show; those without a second share are left out.
    """
    rows = []
    for name in algorithms:
        having = {share: view for share, view in views.items() if name in view.algorithms}
        if len(having) < 2:
            continue
        cells = set.intersection(*(_cells(view, name) for view in having.values()))
        scores = {share: [view.by_run[name, *cell].score_final for cell in cells] for share, view in having.items()}
        means = {share: fmean(values) for share, values in scores.items() if values}
        rows.append([label_of(name), len(cells), *(number(means.get(share)) for share in views)])
    return markdown_table(["", "runs of each", *views], rows) if rows else None


def _cells(view: View, name: str) -> set[tuple[str, int]]:
    return {(task, seed) for algorithm, task, seed in view.by_run if algorithm == name}


def paper_table(ours: Sequence[Column]) -> str:
    """The paper's table, our columns beside it, and each column's mean over the sets of tasks that it has whole."""
    columns = [*(column for column in published_columns() if column.publisher == PAPER), *ours]
    there = [task for task in TASK_SETS["20 tasks"] if any(task in column.scores for column in columns)]
    rows = [[task, *(number(column.scores.get(task)) for column in columns)] for task in there]
    for name, tasks in TASK_SETS.items():
        rows.append([f"*mean of {name}*", *(number(mean_over(column.scores, tasks)) for column in columns)])
    publishers = {PAPER: "paper"}
    heads = [f"{c.algorithm}, {publishers.get(c.publisher, c.publisher)} ({c.data})" for c in columns]
    return markdown_table(["task", *heads], rows)


def peers_table(ours: Sequence[Column]) -> str:
    """Means over equal sets of tasks of everybody who has such a set whole."""
    rows = []
    for column in (*published_columns(), *ours):
        means = [mean_over(column.scores, tasks) for tasks in TASK_SETS.values()]
        if means.count(None) < len(means):
            rows.append([column.algorithm, column.publisher, column.data, column.measure, *map(number, means)])
    return markdown_table(["algorithm", "of", "data", "score", *TASK_SETS], rows)


def sweeps() -> str:
    """What tuning for each task is worth, as others measured it."""
    found = "; ".join(f"{name} {one:.1f} of {best:.1f}" for name, (one, best) in SWEEPS.items())
    return (
        "One configuration for all tasks is to be held against this: over 15 tasks, in ReBRAC's own sweeps, a random "
        f"configuration scores, of what the best one for each task does, {found} (Tarasov et al. 2023)."
    )


def lacking(cells: Iterable[Cell], planned: int) -> str:
    """The runs that are not there, by algorithm."""
    cells = list(cells)
    if not cells:
        return f"All {planned} planned runs are there."
    by_algorithm = dict[str, dict[str, list[int]]]()
    for cell in cells:
        by_algorithm.setdefault(cell.algorithm, {}).setdefault(cell.task, []).append(cell.seed)
    rows = [[label_of(name), sum(map(len, tasks.values())), _tasks(tasks)] for name, tasks in by_algorithm.items()]
    return f"{len(cells)} of {planned} planned runs are missing.\n\n{markdown_table(['', 'missing', 'where'], rows)}"


def _tasks(tasks: Mapping[str, Sequence[int]]) -> str:
    """Tasks by the seeds that they lack."""
    by_seeds = dict[tuple[int, ...], list[str]]()
    for task, seeds in tasks.items():
        by_seeds.setdefault(tuple(seeds), []).append(task)
    every = len(TASK_SETS["20 tasks"])
    return "; ".join(
        f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))} of "
        f"{'all tasks' if len(names) == every else ', '.join(names)}"
        for seeds, names in by_seeds.items()
    )


def weighted_bc_note(view: View) -> str:
    """What stands for weighted BC in a kit."""
    if WEIGHTED_BC not in view.algorithms:
        return f"Weighted BC, `{WEIGHTED_BC}`, has no runs here: what must not be harmed is the log's mean episode."
    words = "; its rows are drawn by their episodes' returns, as all others' are" if view.kit == "same" else ""
    return f"Weighted BC is `{WEIGHTED_BC}`{words}."
