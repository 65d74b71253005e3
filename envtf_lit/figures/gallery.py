"""All plots of the evaluate stage, under the names that the report and dvc.yaml know them by."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from envtf_lit.data.cards import counted_episodes
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.horizon import HorizonReport
from envtf_lit.evaluation.metrics import comparable
from envtf_lit.evaluation.offline import OfflineEstimates
from envtf_lit.evaluation.promises import Places
from envtf_lit.figures import learning, model, scores
from envtf_lit.figures.frontier import frontier_picture
from envtf_lit.figures.style import write_table
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.robots.returns import Returns
from envtf_lit.robots.tasks import Robot
from envtf_lit.world_models.forecast import Scale


def draw_dataset(dataset: OfflineDataset, source: str, folder: Path) -> None:
    """Draws `dataset_returns`, of the episodes that count (see `counted_episodes`)."""
    counted = counted_episodes(dataset, source)
    returns, lengths = dataset.episode_returns[counted], dataset.episode_lengths[counted]
    scores.returns_histogram(returns, lengths, folder / "dataset_returns.png")


def draw_world_model(
    report: HorizonReport, scale: Scale, robot: Robot | None, curves: pd.DataFrame, folder: Path
) -> None:
    """Draws `world_model_curves`, `horizon`, `one_step`, `calibration`, `traces`, and the table `horizon_steps.csv`."""
    name = robot.name if robot else None
    learning.learning_curves(
        {"world_model": curves}, folder / "world_model_curves.png", title="World model, in training"
    )
    model.horizon_errors(report, folder / "horizon.png")
    model.one_step_predictions(report, name, folder / "one_step.png")
    model.calibration_curve(report, scale, name, folder / "calibration.png")
    model.traces(report, name, folder / "traces.png")
    write_table(folder / "horizon_steps.csv", model.horizon_table(report))


def draw_rollouts(rollouts: Rollouts, folder: Path) -> None:
    """Draws `rollout_uncertainty`, of the stored rollouts."""
    step = rollouts.valid.nonzero()[:, 0].numpy()
    uncertainty = rollouts.uncertainty[rollouts.valid].numpy()
    model.rollout_uncertainty(step, uncertainty, folder / "rollout_uncertainty.png")


def draw_policy_curves(curves: Mapping[str, pd.DataFrame], labels: Mapping[str, str], folder: Path) -> None:
    """Draws `policy_curves`, from the curves.csv of each policy."""
    learning.learning_curves(curves, folder / "policy_curves.png", title="Policies, in training", labels=labels)


def draw_scores(
    dataset: OfflineDataset,
    source: str,
    robot: Robot,
    returns: Mapping[str, Returns],
    labels: Mapping[str, str],
    folder: Path,
) -> None:
    """Draws `scores`, of every episode.

    Args:
        dataset: its episodes stand first.
        source: of the dataset, as in `DownloadOptions`; Minari's has no scores, and returns stand in their place.
        robot: gives the scores their scale.
        returns: of each policy, by name.
        labels: what to call each policy.
        folder: to write into.
    """
    unit, recorded, episodes = comparable(dataset, returns, robot, source)
    words = {} if unit == "score" else {"quantity": unit, "title": "Return of every episode"}
    scores.score_strip({"data": recorded}, episodes, folder / "scores.png", labels=labels, **words)


def draw_estimates(estimates: OfflineEstimates, labels: Mapping[str, str], folder: Path) -> None:
    """Draws `scores`, here of imagined returns, for a robot without a simulator.

    Args:
        estimates: of each policy, by name.
        labels: what to call each policy.
        folder: to write into.
    """
    references = {"recorded": estimates.recorded, "imagined": estimates.imagined}
    returns = {name: estimate.returns for name, estimate in estimates.policies.items()}
    words = {"quantity": "return", "title": "Recorded and imagined return of every episode"}
    scores.score_strip(references, returns, folder / "scores.png", labels=labels, **words)


def draw_frontiers(
    frontiers: Mapping[str, Places],
    held_out: Mapping[str, float],
    dataset: OfflineDataset,
    source: str,
    labels: Mapping[str, str],
    measured: Mapping[str, float],
    folder: Path,
) -> None:
    """Draws `frontier`, where a policy has one.

    Args:
        frontiers: of the policies that have one, by name.
        held_out: of the metrics: how the model errs on recorded actions.
        dataset: its episodes that count are what promises are compared with.
        source: of the dataset, as in `DownloadOptions`.
        labels: what to call each policy.
        measured: mean returns in the simulator, of policies by name and of their clones by `NAME/clone`.
        folder: to write into.
    """
    if frontiers:
        recorded = float(dataset.episode_returns[counted_episodes(dataset, source)].mean())
        frontier_picture(
            frontiers,
            folder / "frontier.png",
            held_out=held_out,
            recorded=recorded,
            policies=labels,
            measured=measured,
        )
