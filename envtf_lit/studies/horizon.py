"""`envtf horizon`: how long world models track reality, for several robots, into one JSON, one table and figures."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import pandas as pd
import torch

from envtf_lit.data.cards import markdown_table
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import THRESHOLDS
from envtf_lit.evaluation.physics import Physics, ceiling
from envtf_lit.evaluation.tracking import Tracking, fresh_episodes, track, track_ceiling, track_sampled
from envtf_lit.figures import horizons
from envtf_lit.files import write_json, write_text
from envtf_lit.results import claim
from envtf_lit.robots.returns import SEED_OFFSET
from envtf_lit.robots.tasks import Task, get_task
from envtf_lit.studies.suite import (
    MODELS,
    PHYSICS,
    WORK,
    Suite,
    SuiteOptions,
    build_suite,
    flat_settings,
    heading,
    kept,
    measurable,
    other_folders,
)
from envtf_lit.training import pick_device, run_folder
from envtf_lit.world_models.forecast import Scale, Trajectories, whole_episodes

ONLINE = ("random", "medium", "expert")  # policies of the zoo that drive MuJoCo
SIZES = (1e-4, 1e-3, 1e-2, 1e-1)  # of disturbances, at which the ceiling is drawn
FORMAT = 2  # of kept results; those of before lack explosions and are measured anew
RECORDED = "recorded"  # the tier's own episodes
SUITE, EPISODES = "suite", "episodes"  # parts of the work, beside physics and the models

Results = dict[str, dict[str, Tracking]]  # of a robot, by model and source of the episodes


@dataclass(frozen=True)
class HorizonOptions:
    """The trajectories that models are measured on.

    Attributes:
        trajectories: fresh episodes of the tier's behaviour policies, from their first step.
        online: fresh episodes of each of the three online policies.
        start: steps of each episode that are left out, and with them the episodes that end before, and an online
            policy that has no other.
    """

    trajectories: int = 300
    online: int = 100
    start: int = 0


def compare(
    out: Path,
    *,
    robots: Sequence[str],
    tier: str = "medium-replay",
    work: Path = WORK,
    options: SuiteOptions,
    measured: HorizonOptions,
    models: Sequence[str] = MODELS,
    others: Mapping[str, str] | None = None,
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measures every model on every robot; what an interrupted call has measured is kept below `work`.

    Args:
        out: JSON file to write after each robot; a table `.md` and a folder of figures of that name lie beside it.
        robots: names.
        tier: of the data that models are trained and measured on.
        work: folder of suites; what was trained or measured there before with the same options is used again.
        options: of the data and the models.
        measured: how many episodes.
        models: which of the suite's.
        others: further models, name to folder; `{task}` and `{robot}` in a folder stand for those names.
        progress: shows bars.
        report: called with a line for each thing done.

    Returns:
        What the file holds, under flat keys: `flat_numbers` and what they depend on.

    Raises:
        UserError: an unknown robot or tier, too few episodes, a folder without a world model of the robot, a name that
            is taken, or a file in the way that is none of this command's.
    """
    tasks = [get_task(f"{robot}-{tier}") for robot in dict.fromkeys(robots)]
    further = other_folders(others or {}, tasks)
    if min(measured.trajectories, measured.online) < 1:
        raise UserError("A length is a mean over at least one trajectory: ask for more than none.")
    claim(out, "measured.trajectories", [out.with_suffix(".md"), *_figures(out.with_suffix(""))])
    torch.set_num_threads(options.threads)
    clock = _Clock([SUITE, EPISODES, PHYSICS, *models, *(others or {})], len(tasks), report)
    found: dict[str, Results] = {}
    numbers = heading(tier, options, measured=measured)
    for task in tasks:
        robot = task.robot.name
        built = build_suite(task.name, work, options, models=models, progress=progress)
        clock.done(SUITE, f"{robot}: dataset and models")
        course = _Course(task, built, work / task.name, measured, progress)
        clock.done(EPISODES, f"{robot}: {course.episodes} fresh episodes")
        found[robot] = {PHYSICS: course.measure_physics()}
        clock.done(PHYSICS, f"{robot}: the ceiling set by physics")
        for name, folder in (built.folders | further[task.name]).items():
            found[robot][name] = course.measure(name, folder)
            clock.done(name, f"{robot}: {name}: {_headline(found[robot][name][RECORDED].numbers)}")
        numbers |= built.costs | flat_numbers({robot: found[robot]})
        write_json(out, numbers)
        write_text(out.with_suffix(".md"), page(found, tier))
        draw(found, out.with_suffix(""))
    return numbers


def _headline(numbers: Mapping[str, float]) -> str:
    reached = ((t, numbers[f"open_loop_{t:g}"], numbers[f"ceiling_{t:g}"]) for t in THRESHOLDS)
    return ", ".join(f"{steps:.1f} of {most:.1f} steps within {threshold:g}" for threshold, steps, most in reached)


class _Clock:
    """Says what is done and about how long the rest takes, judged by the same part on other robots, or by any part.

    Args:
        parts: of the work on one robot.
        rounds: robots.
        report: is given the lines.
    """

    def __init__(self, parts: Sequence[str], rounds: int, report: Callable[[str], None]) -> None:
        self.left = dict.fromkeys(parts, rounds)
        self.report, self.begin = report, time.perf_counter()
        self.seconds: dict[str, list[float]] = {}

    def done(self, part: str, line: str) -> None:
        """Notes that a part is done; one that lay there already tells nothing about the rest."""
        elapsed, self.begin = time.perf_counter() - self.begin, time.perf_counter()
        self.left[part] -= 1
        if elapsed > 1.0:
            self.seconds.setdefault(part, []).append(elapsed)
        every = [value for values in self.seconds.values() for value in values] or [0.0]
        left = sum(count * fmean(self.seconds.get(name, every)) for name, count in self.left.items())
        self.report(f"{line} ({elapsed:.0f} s; about {left / 60:.0f} min left)")


class _Course:
    """One robot's episodes and physics, on which models are measured; results are kept in `home`.

    Args:
        task: robot and tier.
        suite: gives the training data, whose spread is the unit of errors.
        home: folder of the task.
        measured: how many episodes.
        progress: shows bars.
    """

    def __init__(self, task: Task, suite: Suite, home: Path, measured: HorizonOptions, progress: bool) -> None:
        self.home, self.suite = home, suite
        self.seed, self.start = suite.options.seed, measured.start
        self.device, self.robot = pick_device(), task.robot
        self.key = flat_settings(task.tier, suite.options, measured=measured)
        if measured.start > 0 and task.robot.clipped_from is not None:
            self.key["clipped_starts"] = "left out"  # they once counted, and results of then are others
        wanted = {RECORDED: (task, measured.trajectories)}
        wanted |= {name: (Task(task.robot, name), measured.online) for name in ONLINE}
        folder = run_folder(home, "episodes", self.key | {"measured.start": 0}, [])  # the same from every start
        fresh = {
            source: self._fresh(folder / f"{source}.h5", *ask, workers=suite.options.threads, progress=progress)
            for source, ask in wanted.items()
        }
        self.trajectories = {source: found for source, found in fresh.items() if len(found.lengths) > 0}
        if RECORDED not in self.trajectories:
            raise UserError(
                f"No episode of {task.name} lasts longer than {self.start} steps: start earlier, or take more episodes."
            )
        self.key["format"] = FORMAT
        self.scale, self.physics = Scale.of(suite.split()[0], self.device), Physics(task.robot)

    def _fresh(self, file: Path, task: Task, count: int, *, workers: int, progress: bool) -> Trajectories:
        if not file.exists():
            seed = self.seed + SEED_OFFSET
            save_dataset(fresh_episodes(task, count, seed=seed, workers=workers, progress=progress), file)
        return whole_episodes(load_dataset(file), count, seed=self.seed).later(self.start).to(self.device)

    @property
    def episodes(self) -> str:
        return " + ".join(f"{len(found.lengths)} {source}" for source, found in self.trajectories.items())

    def measure_physics(self) -> dict[str, Tracking]:
        """Ceilings by the size of the disturbance, as text."""
        return self._kept(PHYSICS, [], lambda: {f"{size:g}": self._ceiling("ceiling", size) for size in SIZES})

    def measure(self, name: str, folder: Path) -> dict[str, Tracking]:
        """A model's results by source of the episodes; the recorded ones with ceilings at its own one-step error."""

        def work() -> dict[str, Tracking]:
            model = measurable(folder, self.suite.options)
            sources, rule = self.trajectories.items(), self.robot.terminated
            found = {source: track(model, episodes, self.scale, rule) for source, episodes in sources}
            drawn = track_sampled(model, self.trajectories[RECORDED], self.scale, seed=self.seed)
            errors = found[RECORDED].numbers
            most = self._ceiling("ceiling", errors["one_step_nrmse"])
            typical = self._ceiling("ceiling_typical", errors["one_step_typical"])
            return found | {RECORDED: found[RECORDED] | drawn | most | typical}

        return self._kept(name, [folder], work)

    def _ceiling(self, name: str, size: float) -> Tracking:
        found = ceiling(self.physics, self.trajectories[RECORDED], self.scale, size, seed=self.seed)
        return track_ceiling(name, found, self.robot.terminated)

    def _kept(self, name: str, inputs: list[Path], work: Callable[[], dict[str, Tracking]]) -> dict[str, Tracking]:
        """Results of the work, now or when it was done on the same inputs."""

        def plain() -> dict[str, Any]:
            return {source: asdict(tracking) for source, tracking in work().items()}

        found = kept(self.home, f"horizon-{name}", self.key, [self.suite.dataset, *inputs], plain)
        return {source: Tracking(**content) for source, content in found.items()}


def flat_numbers(found: Mapping[str, Results]) -> dict[str, float]:
    """`robot.model.name` of the recorded episodes, `robot.model.policy.name` online, `robot.physics.SIZE.name`."""
    numbers = {}
    for robot, results in found.items():
        for model, sources in results.items():
            for source, tracking in sources.items():
                prefix = f"{robot}.{model}" if source == RECORDED else f"{robot}.{model}.{source}"
                numbers |= {f"{prefix}.{name}": value for name, value in tracking.numbers.items()}
    return numbers


def page(found: Mapping[str, Results], tier: str) -> str:
    """The tables in Markdown."""
    offline, online = [], []
    for robot, results in found.items():
        for model, sources in results.items():
            if model == PHYSICS:
                continue
            numbers = sources[RECORDED].numbers
            offline.append(_offline_row(robot, model, numbers))
            for source, tracking in sources.items():
                if source != RECORDED:
                    online.append((robot, model, source, *_online_cells(tracking.numbers)))
    tables = (
        (f"Recorded actions of {tier}", OFFLINE_HEAD, offline),
        ("Actions of policies that drive MuJoCo", ONLINE_HEAD, online),
    )
    return "\n".join(f"## {title}\n\n{markdown_table(head, rows)}\n" for title, head, rows in tables)


OFFLINE_HEAD = (
    "robot", "model", "one-step error (typical)", "open loop 0.01", "ceiling 0.01 (typical)", "open loop 0.1",
    "ceiling 0.1 (typical)", "sampled 0.1", "teacher-forced 0.01", "censored 0.1", "exploded (standing)",
    "physics exploded (typical)",
)  # fmt: skip
ONLINE_HEAD = ("robot", "model", "policy", "open loop 0.01", "open loop 0.1", "censored 0.1", "exploded")


def _steps(numbers: Mapping[str, float], name: str) -> str:
    return f"{numbers[name]:.1f} ± {numbers[f'{name}_standard_error']:.1f}"


def _offline_row(robot: str, model: str, numbers: Mapping[str, float]) -> tuple[str, ...]:
    def ceilings(threshold: str) -> str:
        return f"{numbers[f'ceiling_{threshold}']:.1f} ({numbers[f'ceiling_typical_{threshold}']:.1f})"

    return (
        robot,
        model,
        f"{numbers['one_step_nrmse']:.3f} ({numbers['one_step_typical']:.3f})",
        _steps(numbers, "open_loop_0.01"),
        ceilings("0.01"),
        _steps(numbers, "open_loop_0.1"),
        ceilings("0.1"),
        _steps(numbers, "sampled_open_loop_0.1"),
        _steps(numbers, "teacher_forced_0.01"),
        f"{numbers['open_loop_0.1_censored']:.0%}",
        f"{numbers['explosion_rate']:.1%} ({numbers['explosion_rate_standing']:.1%})",
        f"{numbers['ceiling_explosion_rate']:.1%} ({numbers['ceiling_typical_explosion_rate']:.1%})",
    )


def _online_cells(numbers: Mapping[str, float]) -> tuple[str, ...]:
    shares = f"{numbers['open_loop_0.1_censored']:.0%}", f"{numbers['explosion_rate']:.1%}"
    return (*(_steps(numbers, f"open_loop_{threshold:g}") for threshold in THRESHOLDS), *shares)


def _figures(folder: Path) -> list[Path]:
    """What `draw` writes."""
    names = ("open_loop", "teacher_forced", "online", "ceiling")
    return [folder / f"{name}{ending}" for name in names for ending in (".png", ".csv")]


def draw(found: Mapping[str, Results], folder: Path) -> None:
    """Every figure into a folder, each with its numbers as CSV beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    curves = _curves(found)
    recorded, online = curves.query("source == @RECORDED"), curves.query("source != @RECORDED")
    horizons.error_growth(recorded, "open_loop", folder / "open_loop.png")
    horizons.error_growth(recorded, "teacher_forced", folder / "teacher_forced.png")
    if len(online):
        horizons.online_growth(online, folder / "online.png")
    horizons.steps_against_ceiling(_lengths(found), folder / "ceiling.png")


def _curves(found: Mapping[str, Results]) -> pd.DataFrame:
    return pd.concat(
        pd.DataFrame(columns).assign(robot=robot, model=model, source=source, run=run)
        for robot, results in found.items()
        for model, sources in results.items()
        if model != PHYSICS
        for source, tracking in sources.items()
        for run, columns in tracking.curves.items()
    )


def _lengths(found: Mapping[str, Results]) -> pd.DataFrame:
    """Open-loop lengths of models, and ceilings, against the size of the error that is typical of a step."""
    rows = []
    for robot, results in found.items():
        for model, sources in results.items():
            for source, tracking in sources.items():
                if source in ONLINE:
                    continue
                numbers, run = tracking.numbers, "ceiling" if model == PHYSICS else "open_loop"
                error = float(source) if model == PHYSICS else numbers["one_step_typical"]
                for name, threshold in ((f"{run}_{threshold:g}", threshold) for threshold in THRESHOLDS):
                    rows.append((robot, model, threshold, error, numbers[name], numbers[f"{name}_standard_error"]))
    return pd.DataFrame(rows, columns=["robot", "model", "threshold", "error", "steps", "standard_error"])
