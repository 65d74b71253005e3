"""The stage `evaluate`: scores policies and the world model."""

from pathlib import Path
from typing import Any

import pandas as pd

from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import collect_metrics, collect_promises, world_model_metrics
from envtf_lit.evaluation.offline import judge
from envtf_lit.figures import gallery
from envtf_lit.figures.video import no_video, real_vs_imagined
from envtf_lit.files import replacing, write_json
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import (
    ALGORITHMS,
    BEHAVIOUR,
    DATASET,
    METRICS,
    PLOTS,
    POLICIES,
    ROLLOUTS,
    VIDEO,
    WORLD_MODEL,
    robot_of,
    run_stage,
)
from envtf_lit.policy import load_policy
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.training import CURVES
from envtf_lit.world_models.forecast import Scale, whole_episodes
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination import termination_source
from envtf_lit.world_models.uncertainty.recalibration import calibration_split


def evaluate(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Scores policies and the model: `reports/metrics.json`, `plots/`, `video/`.

    The model is scored on held-out episodes, policies in MuJoCo. For a robot without a simulator (`task: null`) there
    are no scores: what the model promises the policies, and how they agree with held-out actions, is all.
    """
    options, robot, source = params.evaluate, robot_of(params), params.download.source
    with run_stage("evaluate", params, root):
        dataset, rollouts = load_dataset(root / DATASET), load_rollouts(root / ROLLOUTS)
        model = load_world_model(root / WORLD_MODEL)
        training, held_out = dataset.split(params.train_model.held_out, seed=params.seed)
        _, held_out = calibration_split(held_out)
        scale = Scale.of(training)
        report = horizon_report(model, whole_episodes(held_out, options.trajectories, seed=params.seed), scale)
        folders = {"bc": BEHAVIOUR, **{name: POLICIES / name for name in ALGORITHMS}}
        policies = {name: load_policy(root / folder) for name, folder in folders.items()}
        curves = {name: _curves(root / POLICIES / name) for name in ALGORITHMS}
        facts: dict[str, Any] = dict(
            seed=params.seed,
            dataset=dataset,
            world_model=world_model_metrics(report, scale, parameters=sum(p.numel() for p in model.parameters()))
            | {"termination": termination_source(params.task, root / WORLD_MODEL)},
            rollouts=len(rollouts),
        )
        with replacing(root / PLOTS) as plots, replacing(root / VIDEO) as video:
            plots.mkdir()
            video.mkdir()
            gallery.draw_dataset(dataset, source, plots)
            gallery.draw_world_model(report, scale, robot, _curves(root / WORLD_MODEL), plots)
            gallery.draw_rollouts(rollouts.step.numpy(), rollouts.uncertainty.numpy(), plots)
            if robot is None:
                promises = judge(model, policies, report, training)
                metrics = collect_promises(promises, **facts)
                gallery.draw_promises(promises, curves, plots)
                no_video(video)
            else:
                returns = {
                    name: evaluate_policy(policy, robot, episodes=options.episodes, seed=params.seed, progress=progress)
                    for name, policy in policies.items()
                }
                metrics = collect_metrics(returns, task=str(params.task), source=source, robot=robot, **facts)
                gallery.draw_policies(dataset, source, robot, returns, curves, plots)
                episode, gif = returns["et_cql"].median, video / "real_vs_imagined.gif"
                real_vs_imagined(model, episode, robot, scale, gif, frames=options.video_frames)
        write_json(root / METRICS, metrics)
    return metrics


def _curves(folder: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(folder / CURVES)
    except (FileNotFoundError, pd.errors.EmptyDataError):
        raise UserError(
            f"{folder} has no {CURVES}, which the plots are drawn from: run the stage that writes the folder, or copy "
            "one there that `fit` published after an epoch or more."
        ) from None
