"""`envtf calibrate`: what models know of their own errors, for several robots, into one JSON, a table and a figure."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from envtf_lit.data.cards import markdown_table
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.calibration import (
    Points,
    auroc,
    coverage,
    draw_points,
    novelties,
    proper_scores,
    rank_correlation,
    recalibrated,
    roc_curve,
    rollout_errors,
    with_uniform_actions,
)
from envtf_lit.evaluation.physics import Physics
from envtf_lit.figures.calibration import calibration_page
from envtf_lit.files import write_json, write_text
from envtf_lit.results import claim
from envtf_lit.robots.returns import SEED_OFFSET
from envtf_lit.robots.tasks import Task, get_task
from envtf_lit.studies.suite import (
    MODELS,
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
from envtf_lit.training import pick_device
from envtf_lit.world_models.forecast import Scale, forecast, whole_episodes
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import load_snapshot, read_series

CONTRASTS = ("expert", "random_policy", "random_action")  # what is strange to a model of medium data
LEVELS = (0.05, *(k / 10 for k in range(1, 10)), 0.95)  # at which coverage is drawn
FORMAT = 2  # of kept results; those of before lack numbers and are measured anew
PARTS = 20  # of a rollout's steps in order of u, at which errors are drawn

Curves = dict[str, dict[str, list[float]]]  # by kind: named columns
Measured = tuple[dict[str, float], Curves]


@dataclass(frozen=True)
class CalibrationOptions:
    """What is measured.

    Attributes:
        points: state-action pairs of each kind, or as many as there are.
        strange_rows: transitions collected to draw those of the expert and of the random policy from.
        episodes: held-out ones that intervals are judged on, at most.
        rollouts: of the model, under the expert.
        rollout_steps: of each, at most.
    """

    points: int = 4_000
    strange_rows: int = 20_000
    episodes: int = 50
    rollouts: int = 200
    rollout_steps: int = 25


@dataclass(frozen=True)
class Findings:
    """What is reported of one model on one robot.

    Attributes:
        numbers: by name; docs/calibration.md explains them.
        curves: what the figure shows.
    """

    numbers: dict[str, float]
    curves: Curves


Results = dict[str, Findings]  # of a robot, by model


def compare(
    out: Path,
    *,
    robots: Sequence[str],
    tier: str = "medium",
    work: Path = WORK,
    options: SuiteOptions,
    measured: CalibrationOptions = CalibrationOptions(),
    others: Mapping[str, str] | None = None,
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measures every model on every robot; what an interrupted call has measured is kept below `work`.

    Args:
        out: JSON file to write after each robot, with flat keys; a table `.md` and a figure `.png` appear beside it.
        robots: names.
        tier: of the data that the models are trained on.
        work: where datasets, models and results are kept, as `build_suite` has it.
        options: how the models are trained.
        measured: what is measured of them.
        others: further models, name to folder; `{task}` and `{robot}` in a folder stand for those names.
        progress: shows bars.
        report: called with a line for each robot.

    Returns:
        What `out` holds.

    Raises:
        UserError: an unknown robot or tier, a folder without a world model of the robot, a name that is taken, or
            a file in the way that is none of this command's.
    """
    tasks = [get_task(f"{robot}-{tier}") for robot in dict.fromkeys(robots)]
    further = other_folders(others or {}, tasks)
    claim(out, "calibration.points", [out.with_suffix(ending) for ending in (".md", ".png", ".csv")])
    torch.set_num_threads(options.threads)
    found: dict[str, Results] = {}
    numbers = heading(tier, options, calibration=measured)
    for task in tasks:
        name = task.robot.name
        built = build_suite(task.name, work, options, progress=progress)
        found[name] = measure(task, built, work / task.name, measured, others=further[task.name], progress=progress)
        numbers |= built.costs | flat_numbers({name: found[name]})
        write_json(out, numbers)
        write_text(out.with_suffix(".md"), page(found, tier))
        curves = {robot: {model: one.curves for model, one in results.items()} for robot, results in found.items()}
        calibration_page(curves, out.with_suffix(".png"))
        report(f"{name}: {_headline(found[name])} ({len(found)} of {len(tasks)})")
    return numbers


def measure(
    task: Task, suite: Suite, home: Path, options: CalibrationOptions, *, others: Mapping[str, Path], progress: bool
) -> Results:
    """Everything about one robot's models, on the same episodes, pairs and first states for each.

    Args:
        task: robot and tier that the models were trained on.
        suite: data and models.
        home: below it lies what was measured before of the same models.
        options: what is measured.
        others: folders of further models, by name.
        progress: shows bars while strange data are collected.
    """
    course = cache(partial(Course, task, suite, options, progress))
    settings = flat_settings(task.tier, suite.options, calibration=options)
    settings["format"] = FORMAT

    def one(folder: Path) -> dict[str, Any]:
        place = course()
        begin = time.perf_counter()
        findings = place.measure(measurable(folder, suite.options))
        return asdict(findings) | {"numbers": findings.numbers | {"seconds": round(time.perf_counter() - begin, 1)}}

    return {
        name: Findings(**kept(home, f"calibration-{name}", settings, [suite.dataset, folder], partial(one, folder)))
        for name, folder in (suite.folders | dict(others)).items()
    }


def flat_numbers(found: Mapping[str, Results]) -> dict[str, float]:
    """`robot.model.name`, and `robot.coverage_50` and `_90` of the model that this package is about."""
    numbers = {}
    for robot, results in found.items():
        for model, findings in results.items():
            numbers |= {f"{robot}.{model}.{name}": value for name, value in findings.numbers.items()}
        for level in (50, 90):
            numbers[f"{robot}.coverage_{level}"] = results[MODELS[0]].numbers[f"coverage_{level}"]
    return numbers


class Course:
    """What a robot's models are measured on.

    Args:
        task: robot and tier.
        suite: gives training and held-out episodes.
        options: what is measured.
        progress: shows bars.
    """

    def __init__(self, task: Task, suite: Suite, options: CalibrationOptions, progress: bool) -> None:
        seed, self.options, self.device = suite.options.seed, options, pick_device()
        training, calibrating, held_out = suite.split()
        self.scale = Scale.of(training, self.device)
        self.episodes = whole_episodes(held_out, options.episodes, seed=seed).to(self.device)
        self.calibrating = None
        if calibrating is not None:
            self.calibrating = whole_episodes(calibrating, options.episodes, seed=seed).to(self.device)
        history = suite.options.context - 1  # all that the transformer can use

        def pairs(dataset: OfflineDataset, count: int = options.points, *, stream: int = 0) -> Points:
            return draw_points(dataset, count, history=history, seed=seed + stream)

        self.familiar = pairs(held_out)
        low, high = held_out.action_low, held_out.action_high
        self.strange = {
            name: pairs(
                collect(
                    Task(task.robot, tier),
                    options.strange_rows,
                    seed=seed + SEED_OFFSET,
                    workers=suite.options.threads,
                    progress=progress,
                )
            )
            for name, tier in (("expert", "expert"), ("random_policy", "random"))
        } | {"random_action": with_uniform_actions(self.familiar, low, high, seed=seed)}
        series = read_series(task.robot)
        self.starts, self.physics = pairs(held_out, options.rollouts, stream=1), Physics(task.robot)
        self.expert = load_snapshot(series, series.expert.steps).to(self.device)
        real = self.familiar.observations[torch.arange(len(self.familiar.lengths)), self.familiar.lengths - 1]
        self.deepest = float(self.physics.depth(real.cpu().numpy()).max())

    def measure(self, model: WorldModel) -> Findings:
        """All of one model."""
        findings = Findings({}, {})
        for part in (self.intervals, self.detection, self.rollouts):
            numbers, curves = part(model)
            findings.numbers.update(numbers)
            findings.curves.update(curves)
        return findings

    def intervals(self, model: WorldModel) -> Measured:
        """Coverage and proper scores on held-out episodes."""
        teacher_forced = forecast(model, self.episodes, feedback="recorded")
        covered = {
            round(100 * level): coverage(teacher_forced, self.episodes, self.scale, level).mean for level in LEVELS
        }
        curve = {"nominal": [level / 100 for level in covered], "observed": list(covered.values())}
        numbers = {f"coverage_{level}": covered[level] for level in (50, 90)}
        numbers |= asdict(proper_scores(teacher_forced, self.episodes, self.scale))
        if self.calibrating is not None:  # models that were not recalibrated are, all by the same rule
            seen = forecast(model, self.calibrating, feedback="recorded")
            fitted = proper_scores(recalibrated(teacher_forced, seen, self.calibrating), self.episodes, self.scale)
            numbers |= {f"fitted_{name}": value for name, value in asdict(fitted).items()}
        return numbers, {"coverage": curve}

    def detection(self, model: WorldModel) -> Measured:
        """Strange pairs against familiar ones, by epistemic variance; nothing of a model that has none."""
        known = novelties(model, self.familiar.to(self.device))
        numbers, curves = {}, {}
        for contrast, points in self.strange.items():
            scores = novelties(model, points.to(self.device))
            if known is None or scores is None:
                continue
            numbers[f"auroc_{contrast}"] = auroc(known, scores)
            false, true = roc_curve(known, scores)
            curves[f"roc_{contrast}"] = {"false": false.tolist(), "true": true.tolist()}
        return numbers, curves

    def rollouts(self, model: WorldModel) -> Measured:
        """The uncertainty u against the true error along the model's own rollouts."""
        starts, steps = self.starts.to(self.device), self.options.rollout_steps
        run = rollout_errors(model, self.expert, starts, self.physics, self.scale, steps=steps)
        above = run.depth <= self.deepest
        numbers = {
            "rank_correlation": rank_correlation(run.uncertainty, run.error),
            "rank_correlation_above_ground": rank_correlation(run.uncertainty[above], run.error[above]),
            "sunk": int((~above).sum()) / max(1, len(above)),
            "given_up": run.given_up,
            "clipped": run.clipped,
        }
        return numbers, {"errors": _quantiles(run.uncertainty, run.error)}


def _quantiles(uncertainty: np.ndarray, error: np.ndarray) -> dict[str, list[float]]:
    """Quartiles of the error, and the median u, of the steps in order of u, cut into parts of equal size."""
    parts = np.array_split(np.argsort(uncertainty, kind="stable"), PARTS)
    rows = [[np.median(uncertainty[part]), *np.quantile(error[part], (0.25, 0.5, 0.75))] for part in parts if len(part)]
    return dict(zip(("uncertainty", "lower", "median", "upper"), np.reshape(rows, (-1, 4)).T.tolist(), strict=True))


def _headline(results: Results) -> str:
    ours, theirs = (results[name].numbers for name in ("transformer", "ensemble"))
    areas = (f"{_shown(ours, f'auroc_{name}', 2)} ({_shown(theirs, f'auroc_{name}', 2)})" for name in CONTRASTS)
    return (
        f"50 % intervals hold {ours['coverage_50']:.1%}, 90 % intervals {ours['coverage_90']:.1%}; AUROC (the "
        f"ensemble's) {', '.join(areas)}; rank correlation {ours['rank_correlation']:.2f} "
        f"({theirs['rank_correlation']:.2f}), above ground {ours['rank_correlation_above_ground']:.2f} "
        f"({theirs['rank_correlation_above_ground']:.2f})"
    )


def _shown(numbers: Mapping[str, float], name: str, digits: int = 3) -> str:
    return f"{numbers[name]:.{digits}f}" if name in numbers else "–"


HEAD = (
    "robot", "model", "50 % interval", "90 % interval", "NLL", "NLL, fitted", "CRPS", "CRPS, fitted",
    "expert", "random policy", "random action", "own rollouts", "above ground", "sunk",
)  # fmt: skip


def page(found: Mapping[str, Results], tier: str) -> str:
    """The table in Markdown."""
    detected = (f"auroc_{name}" for name in CONTRASTS)
    ranked = ("rank_correlation", "rank_correlation_above_ground", "sunk")
    names = ("coverage_50", "coverage_90", "nll", "fitted_nll", "crps", "fitted_crps", *detected, *ranked)
    rows = [
        (robot, model, *(_shown(findings.numbers, name) for name in names))
        for robot, results in found.items()
        for model, findings in results.items()
    ]
    words = (
        "Share of held-out outcomes in each interval; negative log-density and continuous ranked probability score of "
        "one outcome of one dimension (std), as they are and after every model was fitted to the other half of the "
        "held-out episodes; AUROC of each contrast; rank correlation of uncertainty and true error along own rollouts, "
        "with and without the steps that begin deeper in the ground than any real one, and the share of these. The "
        "intervals of `transformer` and `context_1` are fitted to the other half, too; the ensemble's are as published."
    )
    return f"## Models of {tier} data\n\n{words}\n\n{markdown_table(HEAD, rows)}\n"
