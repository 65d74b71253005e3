"""A folder of the zoo's datasets: each with its card, all in one table and one figure."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from envtf_lit.data.cards import card_page, dataset_card, dataset_scores, markdown_table
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import read_json, write_json, write_text
from envtf_lit.results import has, read_or_none, refuse_others
from envtf_lit.robots.tasks import ROBOTS, TASKS, Task, get_task
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import NOT_D4RL, Series, describe_origin, plan, read_series

TRANSITIONS, FULL = 200_000, 1_000_000
INDEX, FIGURE = "index.json", "returns.png"


@dataclass(frozen=True)
class Entry:
    """A dataset's line in the table: `seconds` is the wall time of collecting and writing, `megabytes` 10^6 bytes."""

    task: str
    env_id: str
    transitions: int
    episodes: int
    mean_score: float
    max_score: float
    seconds: float
    megabytes: float


def build(
    tasks: Sequence[str],
    out: Path,
    *,
    transitions: int,
    seed: int,
    workers: int,
    zoo: Path | None = None,
    draw: Callable[[dict[str, Any], Path], object],
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> list[Entry]:
    """Collects datasets into a folder, and writes its table and its figure anew.

    Each becomes `<task>.h5`, `<task>.json` (its card) and `<task>.md` (the same to read). A dataset that is there, made
    by the same policies with the same seed, size and versions, is left as it is, so an interrupted call continues.

    Args:
        tasks: names.
        out: folder, created if missing.
        transitions: rows of each.
        seed: of environments and actions.
        workers: processes; they do not change the bytes.
        zoo: a folder that `envtf zoo train` wrote; None takes the package's snapshots.
        draw: draws the scores of all datasets in the folder, by name, into a file (`figures.zoo.score_distributions`).
        progress: shows a bar per dataset.
        report: called with one line per dataset.

    Returns:
        The table of all datasets in the folder.

    Raises:
        UserError: no task is given, one is unknown, `transitions` is too small for one, `out` cannot be made, or
            files that are none of the zoo's have the names of its own.
    """
    wanted = [get_task(name) for name in dict.fromkeys(tasks)]
    if not wanted:
        raise UserError("No task is named: give some, such as hopper-medium, or --all.")
    for task in wanted:
        plan(task, transitions, read_series(task.robot, zoo))  # complains before the first is begun
    _claim(wanted, out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot hold datasets ({error.strerror}): choose another folder.") from None
    for number, task in enumerate(wanted, start=1):
        if _is_made(task, out, describe_origin(task, transitions, seed, zoo)):
            outcome = "is there"
        else:
            entry = _make(task, out, transitions=transitions, seed=seed, workers=workers, zoo=zoo, progress=progress)
            outcome = f"mean score {entry.mean_score:.1f}, {entry.seconds:.0f} s"
        report(f"{number} of {len(wanted)}, {task.name}: {outcome}")
    entries = [_entry(card) for card in _cards(out)]
    write_json(out / INDEX, [asdict(entry) for entry in entries])
    write_text(out / Path(INDEX).with_suffix(".md"), index_page(entries))
    draw(_scores(entries, out), out / FIGURE)
    return entries


def _claim(tasks: Sequence[Task], out: Path) -> None:
    """Raises UserError if there are files of the names to be written, and nothing that says they are the zoo's."""
    words = "none of what `zoo build` has made here; move it, or choose another --out"
    for task in tasks:
        card = read_or_none(out / f"{task.name}.json")
        if not (has(card, "source", "task") and (card["source"], card["task"]) == ("zoo", task.name)):
            refuse_others((out / f"{task.name}{ending}" for ending in (".h5", ".json", ".md")), words)
    rows, names = read_or_none(out / INDEX), [field.name for field in fields(Entry)]
    if not (isinstance(rows, list) and all(has(row, *names) for row in rows)):
        beside = (Path(INDEX).with_suffix(".md"), FIGURE, Path(FIGURE).with_suffix(".csv"))
        refuse_others((out / name for name in (INDEX, *beside)), words)


def _is_made(task: Task, out: Path, origin: dict[str, Any]) -> bool:
    card = out / f"{task.name}.json"
    return card.exists() and (out / f"{task.name}.h5").exists() and origin.items() <= read_json(card).items()


def _make(
    task: Task, out: Path, *, transitions: int, seed: int, workers: int, zoo: Path | None, progress: bool
) -> Entry:
    begin = time.perf_counter()
    path = out / f"{task.name}.h5"
    write_json(path.with_suffix(".json"), {"source": "zoo", "task": task.name})  # ours, and not yet whole
    dataset = collect(task, transitions, seed=seed, workers=workers, zoo=zoo, progress=progress)
    save_dataset(dataset, path)
    card = dataset_card(dataset, "zoo", describe_origin(task, transitions, seed, zoo))
    card |= {"seconds": round(time.perf_counter() - begin, 1), "bytes": path.stat().st_size, "workers": workers}
    write_text(path.with_suffix(".md"), card_page(card))
    write_json(path.with_suffix(".json"), card)
    return _entry(card)


def _cards(out: Path) -> Iterator[dict[str, Any]]:
    """The cards of the folder's datasets, in the order of the twenty tasks, variants after them; no others' cards."""
    order, cards = [*TASKS], list[dict[str, Any]]()
    for path in sorted(out.glob("*.json")):
        card = read_json(path) if path.with_suffix(".h5").exists() else None
        if isinstance(card, dict) and card.get("source") == "zoo" and card.get("task") == path.stem and "bytes" in card:
            cards.append(card)
    yield from sorted(cards, key=lambda card: order.index(card["task"]) if card["task"] in order else len(order))


def _entry(card: dict[str, Any]) -> Entry:
    return Entry(
        card["task"],
        card["env_id"],
        card["transitions"],
        card["episodes"],
        mean_score=round(card["scores"]["mean"], 1) + 0.0,  # no minus before a zero
        max_score=round(card["scores"]["max"], 1) + 0.0,
        seconds=card["seconds"],
        megabytes=round(card["bytes"] / 1e6, 1),
    )


def _scores(entries: Sequence[Entry], out: Path) -> dict[str, Any]:
    """Each dataset's D4RL-normalised scores, (episodes,)."""
    datasets = ((entry.task, load_dataset(out / f"{entry.task}.h5")) for entry in entries)
    return {name: dataset_scores(dataset, get_task(name).robot, "zoo") for name, dataset in datasets}


def index_page(entries: Sequence[Entry]) -> str:
    """The table in Markdown."""
    head = ("dataset", "environment", "transitions", "episodes", "mean score", "max score", "seconds", "MB")
    rows = (
        (
            f"[{entry.task}]({entry.task}.md)",
            entry.env_id,
            f"{entry.transitions:,}",
            f"{entry.episodes:,}",
            f"{entry.mean_score:.1f}",
            f"{entry.max_score:.1f}",
            f"{entry.seconds:.0f}",
            f"{entry.megabytes:.1f}",
        )
        for entry in entries
    )
    note = (
        "Scores are D4RL-normalised returns of the episodes (0 a random policy, 100 D4RL's expert), less those cut "
        f"short where the rows of a policy end. {NOT_D4RL}"
    )
    return f"# The zoo's datasets\n\n{markdown_table(head, rows)}\n\n{note}\n\n![Scores of their episodes]({FIGURE})\n"


def catalogue(zoo: Path | None = None) -> list[tuple[str, str, str]]:
    """What can be built: (task, its policies in words, their returns in words), for each of the twenty."""
    lines = []
    for robot in ROBOTS.values():
        series = read_series(robot, zoo)
        lines += [(name, *_in_words(task, series)) for name, task in TASKS.items() if task.robot is robot]
    return lines


def _in_words(task: Task, series: Series) -> tuple[str, str]:
    phases = plan(task, FULL, series)
    scores = [task.robot.normalised_score(phase.mean_return) for phase in phases if phase.mean_return is not None]
    after = [f"{phase.steps:,}" for phase in phases if phase.steps]
    if task.tier == "random":
        return "uniform random actions", ""
    if task.tier == "medium":
        return f"snapshot after {after[0]} steps", _range(scores)
    if task.tier == "medium-expert":
        return f"snapshots after {after[0]} and {after[1]} steps, half each", _range(scores)
    return f"random warm-up, then {len(after)} snapshots up to {after[-1]} steps", _range(scores)


def _range(scores: list[float]) -> str:
    low, high = min(scores), max(scores)
    return f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"
