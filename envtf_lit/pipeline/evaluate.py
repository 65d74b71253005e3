"""The stage `evaluate`: scores policies and the world model."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.agents.trust_levels import CLONE
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import (
    collect_metrics,
    collect_offline_metrics,
    held_out_metrics,
    world_model_metrics,
)
from envtf_lit.evaluation.offline import evaluate_offline
from envtf_lit.evaluation.promises import read_frontier
from envtf_lit.figures import gallery
from envtf_lit.figures.video import ghost_over_real, no_video, real_vs_imagined
from envtf_lit.files import check_plain, replacing, write_json
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.dataset import dataset_of
from envtf_lit.pipeline.params import Params, algorithm_of
from envtf_lit.pipeline.stage import (
    METRICS,
    PLOTS,
    POLICIES,
    VIDEO,
    WORLD_MODELS,
    robot_of,
    rollouts_file,
    run_stage,
)
from envtf_lit.policy import Policy, load_policy
from envtf_lit.robots.returns import Returns, evaluate_policy
from envtf_lit.robots.tasks import Robot
from envtf_lit.training import CURVES
from envtf_lit.world_models.forecast import Scale, whole_episodes
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination_head import termination_source


def evaluate(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Scores policies and the model: `reports/metrics.json`, `plots/`, `video/`.

    The model is scored on held-out episodes, policies in MuJoCo. For a robot without a simulator (`task: null`) there
    are no scores: what the model estimates for the policies, and how they agree with held-out actions, is all. The
    video shows the last policy of `train_policy`.
    """
    options, name = params.evaluate, params.evaluate.world_model
    robot, source = robot_of(params), params.download.source
    with run_stage("evaluate", params, root):
        dataset, rollouts = load_dataset(dataset_of(params, root)), load_rollouts(rollouts_file(root, name))
        folder = root / WORLD_MODELS / name
        model = load_world_model(folder, dataset=dataset)
        training, held_out = dataset.split()
        held_out = held_out.validation_and_test()[1]
        scale = Scale.of(training)
        report = horizon_report(model, whole_episodes(held_out, options.trajectories, seed=params.seed), scale)
        folders = {policy: root / POLICIES / policy for policy in params.train_policy}
        policies = {policy: load_policy(place, guarded=robot is not None) for policy, place in folders.items()}
        curves = {policy: _curves(root / POLICIES / policy) for policy in policies}
        facts: dict[str, Any] = dict(
            seed=params.seed,
            dataset=dataset,
            world_model={"name": name}
            | world_model_metrics(report, scale, parameters=sum(p.numel() for p in model.parameters()))
            | {"termination": termination_source(params.task, folder)},
            rollouts={"transitions": len(rollouts)},
            labels=_labels(params),
        )
        estimates = evaluate_offline(model, {} if robot else policies, report, training)
        frontiers = {policy: table for policy, place in folders.items() if (table := read_frontier(place)) is not None}
        with replacing(root / PLOTS) as plots, replacing(root / VIDEO) as video:
            plots.mkdir()
            video.mkdir()
            gallery.draw_dataset(dataset, source, plots)
            gallery.draw_world_model(report, scale, robot, _curves(folder), plots)
            gallery.draw_rollouts(rollouts, plots)
            gallery.draw_policy_curves(curves, _labels(params), plots)
            if robot is None:
                metrics, measured = collect_offline_metrics(estimates, **facts), {}
                gallery.draw_estimates(estimates, _labels(params), plots)
                no_video(video)
            else:
                clones = {f"{policy}/{CLONE}": load_policy(folders[policy] / CLONE) for policy in frontiers}
                returns = _play(policies, params, robot, progress)
                measured = {name: _mean(found) for name, found in returns.items()}
                measured |= {name: _mean(found) for name, found in _play(clones, params, robot, progress).items()}
                facts |= {"held_out": held_out_metrics(estimates)}
                metrics = collect_metrics(returns, task=str(params.task), source=source, robot=robot, **facts)
                gallery.draw_scores(dataset, source, robot, returns, _labels(params), plots)
                episode, gif = list(returns.values())[-1].median, video / "real_vs_imagined.gif"
                real_vs_imagined(model, episode, robot, scale, gif, frames=options.video_frames)
                ghost_over_real(model, episode, robot, scale, video / "ghost.gif", frames=options.video_frames)
            gallery.draw_frontiers(frontiers, metrics["held_out"], dataset, source, _labels(params), measured, plots)
        for policy in policies:
            metrics["policies"][policy] |= _training_facts(policy, params, curves[policy], measured)
        write_json(root / METRICS, metrics)
    return metrics


def _play(policies: Mapping[str, Policy], params: Params, robot: Robot, progress: bool) -> dict[str, Returns]:
    """Episodes of each policy, by name, from the same starts."""
    episodes = params.evaluate.episodes
    return {
        name: evaluate_policy(actor, robot, episodes=episodes, seed=params.seed, progress=progress)
        for name, actor in policies.items()
    }


def _training_facts(policy: str, params: Params, curves: pd.DataFrame, measured: Mapping[str, float]) -> dict[str, Any]:
    """How a policy was made, and the mean return of its clone where that was measured."""
    options, clone = params.train_policy[policy], measured.get(f"{policy}/{CLONE}")
    return {
        "algorithm": algorithm_of(options),
        "world_model": None if options.world_model == NO_WORLD_MODEL else options.world_model,
        "effective_episodes": _last(curves, EFFECTIVE),
    } | ({} if clone is None else {"clone_return_mean": clone})


def _mean(found: Returns) -> float:
    return float(found.returns.mean())


MOST_CURVES = 16 << 20  # bytes
EFFECTIVE = "train/effective_episodes"  # a column of a policy's curves


def _labels(params: Params) -> dict[str, str]:
    """What figures and tables call each policy: its algorithm, with its own name where several have the same."""
    labels = {name: ALGORITHMS[algorithm_of(options)].label for name, options in params.train_policy.items()}
    found = list(labels.values())
    return {name: label if found.count(label) == 1 else f"{label}: {name}" for name, label in labels.items()}


def _last(curves: pd.DataFrame, column: str) -> float | None:
    """A column's last number; None where there is none, as in curves of an earlier version."""
    if column not in curves:
        return None
    logged = curves[column].dropna()
    return float(logged.iloc[-1]) if len(logged) else None


def _curves(folder: Path) -> pd.DataFrame:
    path = folder / CURVES
    try:
        check_plain(path, MOST_CURVES)
        return pd.read_csv(path)
    except (UnicodeDecodeError, pd.errors.ParserError) as error:
        raise UserError(f"{path} is damaged ({' '.join(str(error).split())}): run the stage that writes it.") from None
    except (FileNotFoundError, pd.errors.EmptyDataError):
        raise UserError(
            f"{folder} has no {CURVES}, which the plots are drawn from: run the stage that writes the folder, or copy "
            "one there that `fit` published after an epoch or more."
        ) from None
