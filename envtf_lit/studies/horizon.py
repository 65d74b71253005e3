"""The study `envtf horizon`: how long world models track reality, beside the ceiling that physics sets."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from envtf_lit.data.cards import markdown_table
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.devices import pick_device
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import THRESHOLDS
from envtf_lit.evaluation.physics import Physics, ceiling
from envtf_lit.evaluation.tracking import Tracking, fresh_episodes, track, track_ceiling, track_sampled
from envtf_lit.figures import horizons
from envtf_lit.files import write_text
from envtf_lit.robots.returns import SEED_OFFSET
from envtf_lit.robots.tasks import Task
from envtf_lit.studies.study import Study
from envtf_lit.studies.suite import PHYSICS, Suite, cached_result, flat_settings, load_for_study
from envtf_lit.training import run_folder
from envtf_lit.world_models.forecast import Scale, Trajectories, whole_episodes

ONLINE = ("random", "medium", "expert")  # policies of the zoo that drive MuJoCo
SIZES = (1e-4, 1e-3, 1e-2, 1e-1)  # of disturbances, at which the ceiling is drawn
FORMAT = 2  # of cached results; those of before lack explosions and are measured anew
RECORDED = "recorded"  # the tier's own episodes
FIGURES = ("open_loop", "teacher_forced", "online", "ceiling")

BySource = dict[str, Tracking]  # of a model, by source of the episodes; of physics, by size of the disturbance
Found = Mapping[str, Mapping[str, BySource]]  # by robot and model


@dataclass(frozen=True)
class HorizonOptions:
    """The numbers of episodes that models are measured on, and where in them a forecast begins.

    Attributes:
        trajectories: fresh episodes of the tier's behaviour policies, from their first step.
        online: fresh episodes of each of the three online policies.
        start: steps of each episode that are left out, and with them the episodes that end before, and an online
            policy that has no other.
    """

    trajectories: int = 300
    online: int = 100
    start: int = 0


@dataclass(frozen=True)
class HorizonStudy(Study[BySource]):
    """Open-loop and teacher-forced lengths of each model, and how long disturbed physics lasts, under `physics`."""

    options: HorizonOptions
    mark: ClassVar[str] = "measured.trajectories"

    def check(self, task: Task) -> None:
        if min(self.options.trajectories, self.options.online) < 1:
            raise UserError("A length is a mean over at least one trajectory: ask for more than none.")

    def measure(
        self, task: Task, suite: Suite, others: Mapping[str, Path], progress: bool
    ) -> Iterator[tuple[str, BySource]]:
        data = HorizonData(task, suite, self.options, progress)
        yield PHYSICS, data.measure_physics()
        for name, folder in (suite.folders | dict(others)).items():
            yield name, data.measure(name, folder)

    def headline(self, finding: BySource) -> str:
        if RECORDED not in finding:
            return f"steps that MuJoCo lasts from {len(finding)} disturbed starts"
        numbers = finding[RECORDED].numbers
        reached = ((t, numbers[f"open_loop_{t:g}"], numbers[f"ceiling_{t:g}"]) for t in THRESHOLDS)
        return ", ".join(f"{steps:.1f} of {most:.1f} steps within {threshold:g}" for threshold, steps, most in reached)

    def numbers(self, findings: Mapping[str, BySource]) -> dict[str, float]:
        """`model.name` of the recorded episodes, `model.policy.name` online, `physics.SIZE.name`."""
        return {
            f"{model}.{name}" if source == RECORDED else f"{model}.{source}.{name}": value
            for model, sources in findings.items()
            for source, tracking in sources.items()
            for name, value in tracking.numbers.items()
        }

    def beside(self, out: Path) -> list[Path]:
        figures = [out.with_suffix("") / f"{name}{ending}" for name in FIGURES for ending in (".png", ".csv")]
        return [out.with_suffix(".md"), *figures]

    def show(self, found: Found, tier: str, out: Path) -> None:
        write_text(out.with_suffix(".md"), page(found, tier))
        draw(found, out.with_suffix(""))


class HorizonData:
    """One robot's fresh episodes and its simulator, on which models are measured; results are cached with the suite.

    Args:
        task: robot and tier.
        suite: gives the training data, whose spread is the unit of errors.
        measured: how many episodes.
        progress: shows bars.

    Raises:
        UserError: no episode lasts longer than `measured.start`.
    """

    def __init__(self, task: Task, suite: Suite, measured: HorizonOptions, progress: bool) -> None:
        self.suite, self.seed, self.start = suite, suite.options.seed, measured.start
        self.device, self.robot = pick_device(), task.robot
        self.key = flat_settings(task.tier, suite.options, measured=measured)
        if measured.start > 0 and task.robot.clipped_from is not None:
            self.key["clipped_starts"] = "left out"  # they once counted, and results of then are others
        wanted = {RECORDED: (task, measured.trajectories)}
        wanted |= {name: (Task(task.robot, name), measured.online) for name in ONLINE}
        folder = run_folder(suite.home, "episodes", self.key | {"measured.start": 0}, [])  # the same from every start
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

    def measure_physics(self) -> BySource:
        """Ceilings by the size of the disturbance, as text."""
        return self._cached(PHYSICS, [], lambda: {f"{size:g}": self._ceiling("ceiling", size) for size in SIZES})

    def measure(self, name: str, folder: Path) -> BySource:
        """A model's results by source of the episodes; the recorded ones with ceilings at its own one-step error."""

        def work() -> BySource:
            model = load_for_study(folder, self.suite.options)
            sources, rule = self.trajectories.items(), self.robot.terminated
            found = {source: track(model, episodes, self.scale, rule) for source, episodes in sources}
            drawn = track_sampled(model, self.trajectories[RECORDED], self.scale, seed=self.seed)
            errors = found[RECORDED].numbers
            most = self._ceiling("ceiling", errors["one_step_nrmse"])
            typical = self._ceiling("ceiling_typical", errors["one_step_typical"])
            return found | {RECORDED: found[RECORDED] | drawn | most | typical}

        return self._cached(name, [folder], work)

    def _ceiling(self, name: str, size: float) -> Tracking:
        found = ceiling(self.physics, self.trajectories[RECORDED], self.scale, size, seed=self.seed)
        return track_ceiling(name, found, self.robot.terminated)

    def _cached(self, name: str, inputs: list[Path], work: Callable[[], BySource]) -> BySource:
        """The work's results, read if they lie there already."""

        def plain() -> dict[str, Any]:
            return {source: asdict(tracking) for source, tracking in work().items()}

        found = cached_result(self.suite.home, f"horizon-{name}", self.key, [self.suite.dataset, *inputs], plain)
        return {source: Tracking(**content) for source, content in found.items()}


def page(found: Found, tier: str) -> str:
    """The Markdown page: a table of recorded actions, and one of policies that drive MuJoCo."""
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


def draw(found: Found, folder: Path) -> None:
    """Every figure into a folder, each with its numbers as CSV beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    curves = _curves(found)
    recorded, online = curves.query("source == @RECORDED"), curves.query("source != @RECORDED")
    free, forced, driven, most = (folder / f"{name}.png" for name in FIGURES)
    horizons.error_growth(recorded, "open_loop", free)
    horizons.error_growth(recorded, "teacher_forced", forced)
    if len(online):
        horizons.online_growth(online, driven)
    horizons.steps_against_ceiling(_lengths(found), most)


def _curves(found: Found) -> pd.DataFrame:
    return pd.concat(
        pd.DataFrame(columns).assign(robot=robot, model=model, source=source, run=run)
        for robot, results in found.items()
        for model, sources in results.items()
        if model != PHYSICS
        for source, tracking in sources.items()
        for run, columns in tracking.curves.items()
    )


def _lengths(found: Found) -> pd.DataFrame:
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
