"""The stage `generate_rollouts`: clones the behaviour policy and lets it act in the world model."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from envtf_lit.agents.bc import clone_behaviour
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.files import pick_device, replacing
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.rollouts import NoisyPolicy, imagine
from envtf_lit.imagination.store import save_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import (
    BEHAVIOUR,
    DATASET,
    ROLLOUTS,
    WORLD_MODEL,
    note_timing,
    run_settings,
    run_stage,
    unseen,
)
from envtf_lit.policy import save_policy
from envtf_lit.training import CURVES, autocast, run_folder
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination import termination_rule


def generate_rollouts(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Clones the behaviour policy and lets it act in the world model: `models/behaviour/`, `data/rollouts.h5`."""
    options = params.generate_rollouts
    with run_stage("generate_rollouts", params, root):
        key = run_settings(params, asdict(options)) | unseen(params)
        dataset = load_dataset(root / DATASET)
        run = run_folder(root, "generate_rollouts", key, [root / DATASET])
        clone, curves = clone_behaviour(
            root / DATASET,
            options,
            seed=params.seed,
            run=run,
            precision=params.precision,
            progress=progress,
            **unseen(params),
        )
        with replacing(root / BEHAVIOUR) as folder:
            save_policy(folder, clone)
            curves.write(folder / CURVES)
        device = pick_device()
        model = load_world_model(root / WORLD_MODEL, fused=params.compile).to(device)
        generator = torch.Generator(device).manual_seed(params.seed)
        points = BranchPoints(dataset, device)
        starts = points.draw_shared(options.branches, options.history, options.share, generator)
        begin = time.perf_counter()
        with autocast(device, params.precision):
            rollouts = imagine(
                model,
                NoisyPolicy(clone.to(device), options.exploration),
                starts,
                horizon=options.horizon,
                terminated=termination_rule(params.task, root / WORLD_MODEL, device),
                novelty_limit=options.novelty_limit,
                mode=options.mode,
                generator=generator,
            )
        rate = len(rollouts) / (time.perf_counter() - begin)
        metrics = {
            "transitions": len(rollouts),
            "terminated": int(rollouts.terminated.sum()),
            "halted": int(rollouts.halted.sum()),
            "uncertainty_mean": float(rollouts.uncertainty.mean()),
        }
        save_rollouts(rollouts, root / ROLLOUTS, provenance=key | {"task": params.task})
        note_timing(root, "imagined_transitions_per_second", rate)
    return metrics
