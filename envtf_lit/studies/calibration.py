"""The study `envtf calibrate`: calibration of world models' uncertainty, and detection of out-of-distribution data."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from envtf_lit.data.cards import markdown_table
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.devices import pick_device
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
from envtf_lit.files import write_text
from envtf_lit.robots.returns import SEED_OFFSET
from envtf_lit.robots.tasks import Task
from envtf_lit.studies.study import Study
from envtf_lit.studies.suite import MODELS, Suite, cached_result, flat_settings, load_for_study
from envtf_lit.world_models.forecast import Scale, forecast, whole_episodes
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import load_snapshot, read_series

CONTRASTS = ("expert", "random_policy", "random_action")  # pairs that medium data hardly hold
LEVELS = (0.05, *(k / 10 for k in range(1, 10)), 0.95)  # at which coverage is drawn
FORMAT = 3  # of cached results; those of before lack numbers, or name them otherwise, and are measured anew
PARTS = 20  # of a rollout's steps in order of u, at which errors are drawn

Curves = dict[str, dict[str, list[float]]]  # by kind: named columns
Measured = tuple[dict[str, float], Curves]


@dataclass(frozen=True)
class CalibrationOptions:
    """The numbers of pairs, episodes and rollouts that models are measured on.

    Attributes:
        points: state-action pairs of each kind, or as many as there are.
        out_of_distribution_rows: transitions collected to draw the expert's and the random policy's pairs from.
        episodes: held-out ones that intervals are judged on, at most.
        rollouts: of the model, under the expert.
        rollout_steps: of each, at most.
    """

    points: int = 4_000
    out_of_distribution_rows: int = 20_000
    episodes: int = 50
    rollouts: int = 200
    rollout_steps: int = 25


@dataclass(frozen=True)
class Findings:
    """Numbers and curves of one model on one robot.

    Attributes:
        numbers: by name; docs/calibration.md explains them.
        curves: what the figure shows.
    """

    numbers: dict[str, float]
    curves: Curves


Found = Mapping[str, Mapping[str, Findings]]  # by robot and model


@dataclass(frozen=True)
class CalibrationStudy(Study[Findings]):
    """Coverage, proper scores, detection of new data, and errors along own rollouts, of each model."""

    options: CalibrationOptions = CalibrationOptions()
    prefix: ClassVar[str] = "calibration"
    mark: ClassVar[str] = "calibration.points"

    def measure(
        self, task: Task, suite: Suite, others: Mapping[str, Path], progress: bool
    ) -> Iterator[tuple[str, Findings]]:
        data = cache(
            partial(CalibrationData, task, suite, self.options, progress)
        )  # made for the first that is measured
        settings = flat_settings(task.tier, suite.options, calibration=self.options) | {"format": FORMAT}

        def one(folder: Path) -> dict[str, Any]:
            points = data()
            begin = time.perf_counter()
            findings = points.measure(load_for_study(folder, suite.options))
            return asdict(findings) | {"numbers": findings.numbers | {"seconds": round(time.perf_counter() - begin, 1)}}

        for name, folder in (suite.folders | dict(others)).items():
            inputs = [suite.dataset, folder]
            found = cached_result(suite.home, f"calibration-{name}", settings, inputs, partial(one, folder))
            yield name, Findings(**found)

    def headline(self, finding: Findings) -> str:
        numbers = finding.numbers
        areas = ", ".join(_shown(numbers, f"auroc_{name}", 2) for name in CONTRASTS)
        return (
            f"50 % intervals hold {numbers['coverage_50']:.1%}, 90 % intervals {numbers['coverage_90']:.1%}; AUROC "
            f"{areas}; rank correlation {numbers['rank_correlation']:.2f}, above ground "
            f"{numbers['rank_correlation_above_ground']:.2f}"
        )

    def numbers(self, findings: Mapping[str, Findings]) -> dict[str, float]:
        """`model.name`, and `coverage_50` and `coverage_90` of the transformer, if it was measured."""
        found = {f"{model}.{name}": value for model, one in findings.items() for name, value in one.numbers.items()}
        levels = ("coverage_50", "coverage_90") if MODELS[0] in findings else ()
        return found | {level: findings[MODELS[0]].numbers[level] for level in levels}

    def beside(self, out: Path) -> list[Path]:
        return [out.with_suffix(ending) for ending in (".md", ".png", ".csv")]

    def show(self, found: Found, tier: str, out: Path) -> None:
        write_text(out.with_suffix(".md"), page(found, tier))
        curves = {robot: {model: one.curves for model, one in results.items()} for robot, results in found.items()}
        calibration_page(curves, out.with_suffix(".png"))


class CalibrationData:
    """The held-out episodes, state-action pairs and starts of rollouts that a robot's models are measured on.

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

        self.in_distribution = pairs(held_out)
        low, high = held_out.action_low, held_out.action_high
        self.out_of_distribution = {
            name: pairs(
                collect(
                    Task(task.robot, tier),
                    options.out_of_distribution_rows,
                    seed=seed + SEED_OFFSET,
                    workers=suite.options.threads,
                    progress=progress,
                )
            )
            for name, tier in (("expert", "expert"), ("random_policy", "random"))
        } | {"random_action": with_uniform_actions(self.in_distribution, low, high, seed=seed)}
        series = read_series(task.robot)
        self.starts, self.physics = pairs(held_out, options.rollouts, stream=1), Physics(task.robot)
        self.expert = load_snapshot(series, series.expert.steps).to(self.device)
        real = self.in_distribution.histories.present
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
        forced = forecast(model, self.episodes, feedback="recorded")
        covered = {round(100 * level): coverage(forced, self.episodes, self.scale, level).mean for level in LEVELS}
        curve = {"nominal": [level / 100 for level in covered], "observed": list(covered.values())}
        numbers = {f"coverage_{level}": covered[level] for level in (50, 90)}
        numbers |= asdict(proper_scores(forced, self.episodes, self.scale))
        if self.calibrating is not None:  # models that were not recalibrated are, all by the same rule
            seen = forecast(model, self.calibrating, feedback="recorded")
            fitted = proper_scores(recalibrated(forced, seen, self.calibrating), self.episodes, self.scale)
            numbers |= {f"fitted_{name}": value for name, value in asdict(fitted).items()}
        return numbers, {"coverage": curve}

    def detection(self, model: WorldModel) -> Measured:
        """Out-of-distribution pairs against held-out ones, by epistemic variance; nothing of a model that has none."""
        inside = novelties(model, self.in_distribution.to(self.device))
        numbers, curves = {}, {}
        for contrast, points in self.out_of_distribution.items():
            scores = novelties(model, points.to(self.device))
            if inside is None or scores is None:
                continue
            numbers[f"auroc_{contrast}"] = auroc(inside, scores)
            false, true = roc_curve(inside, scores)
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
            "below_ground": int((~above).sum()) / max(1, len(above)),
            "given_up": run.given_up,
            "clipped": run.clipped,
        }
        return numbers, {"errors": _quantiles(run.uncertainty, run.error)}


def _quantiles(uncertainty: np.ndarray, error: np.ndarray) -> dict[str, list[float]]:
    """Quartiles of the error, and the median u, of the steps in order of u, cut into parts of equal size."""
    parts = np.array_split(np.argsort(uncertainty, kind="stable"), PARTS)
    rows = [[np.median(uncertainty[part]), *np.quantile(error[part], (0.25, 0.5, 0.75))] for part in parts if len(part)]
    return dict(zip(("uncertainty", "lower", "median", "upper"), np.reshape(rows, (-1, 4)).T.tolist(), strict=True))


def _shown(numbers: Mapping[str, float], name: str, digits: int = 3) -> str:
    return f"{numbers[name]:.{digits}f}" if name in numbers else "–"


HEAD = (
    "robot", "model", "50 % interval", "90 % interval", "NLL", "NLL, fitted", "CRPS", "CRPS, fitted",
    "expert", "random policy", "random action", "own rollouts", "above ground", "below ground",
)  # fmt: skip


def page(found: Found, tier: str) -> str:
    """The Markdown page: a row per robot and model."""
    detected = (f"auroc_{name}" for name in CONTRASTS)
    ranked = ("rank_correlation", "rank_correlation_above_ground", "below_ground")
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
