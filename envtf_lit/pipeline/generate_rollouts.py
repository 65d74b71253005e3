"""The stage `generate_rollouts`: lets a cloned policy act in a world model, for the first imagined rows."""

import time
from pathlib import Path
from typing import Any

import torch

from envtf_lit.data.sources.files import load_dataset
from envtf_lit.devices import pick_device
from envtf_lit.files import check_writable
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.rollouts import NoisyPolicy, Rollouts, imagine
from envtf_lit.imagination.store import save_rollouts
from envtf_lit.pipeline.dataset import dataset_of
from envtf_lit.pipeline.params import Params, one_of
from envtf_lit.pipeline.stage import (
    POLICIES,
    WORLD_MODELS,
    note_timing,
    robot_of,
    rollouts_file,
    run_settings,
    run_stage,
)
from envtf_lit.policy import load_policy
from envtf_lit.world_models.observed import as_observed
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination_head import termination_rule

STRETCH = 16  # rollouts begin at as many consecutive steps of one window, which the model reads once


def generate_rollouts(
    params: Params, root: Path = Path("."), *, name: str | None = None, progress: bool = True
) -> dict[str, Any]:
    """Imagines rollouts of a cloned policy in a world model: `data/rollouts/NAME.h5`.

    Args:
        params: all options.
        root: of the project.
        name: of the world model, a section below `train_model`; None where there is one alone.
        progress: has nothing to show here.

    Returns:
        Numbers of transitions, terminations and halted rollouts, and the mean uncertainty.

    Raises:
        UserError: no such section, or something that the stage reads is missing.
    """
    name = one_of("train_model", params.train_model, name)
    target = rollouts_file(root, name)
    with run_stage(f"generate_rollouts_{name}", params, root):
        rollouts = _imagine(params, root, name)
        settings = run_settings(params, params.generate_rollouts)
        save_rollouts(rollouts, target, provenance=settings | {"task": params.task, "world_model": name})
    return {
        "transitions": len(rollouts),
        "terminated": int(rollouts.terminated.sum()),
        "halted": int(rollouts.halted.sum()),
        "uncertainty_mean": float(rollouts.uncertainty[rollouts.valid].mean()),
    }


def _imagine(params: Params, root: Path, name: str) -> Rollouts:
    """The policy's rollouts in the world model; their rate goes to the side file."""
    options, device, folder = params.generate_rollouts, pick_device(), root / WORLD_MODELS / name
    dataset = load_dataset(dataset_of(params, root))
    points = BranchPoints(dataset, device)
    model = load_world_model(folder, fused=params.compile, dataset=dataset).to(device)
    model = as_observed(model, robot_of(params))
    policy = load_policy(root / POLICIES / options.policy, guarded=False).to(device)
    generator = torch.Generator(device).manual_seed(params.seed)
    histories = points.draw_stretches(options.branches, options.history, STRETCH, generator)
    check_writable(rollouts_file(root, name), folder=False)  # only now: a refused call leaves no folder
    begin = time.perf_counter()
    rollouts = imagine(
        model,
        NoisyPolicy(policy, options.exploration),
        histories,
        horizon=options.horizon,
        terminated=termination_rule(params.task, folder, device),
        novelty_limit=options.novelty_limit,
        generator=generator,
    )
    note_timing(root, "imagined_transitions_per_second", len(rollouts) / (time.perf_counter() - begin))
    return rollouts
