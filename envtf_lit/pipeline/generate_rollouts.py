"""The stage `generate_rollouts`: clones the behaviour policy and lets it act in the world model."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from envtf_lit.agents.bc import cloned_behaviour
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.files import check_writable, pick_device, replacing
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
    key = run_settings(params, asdict(options)) | unseen(params)
    with run_stage("generate_rollouts", params, root):
        check_writable(root / ROLLOUTS, folder=False)
        with cloned_behaviour(
            root / DATASET,
            options,
            seed=params.seed,
            run=run_folder(root, "generate_rollouts", key, [root / DATASET]),
            target=root / BEHAVIOUR,
            precision=params.precision,
            progress=progress,
            **unseen(params),
        ) as (clone, curves):
            with replacing(root / BEHAVIOUR) as folder:
                save_policy(folder, clone)
                curves.write(folder / CURVES)
            rollouts = _imagine_first(params, root, clone)
            save_rollouts(rollouts, root / ROLLOUTS, provenance=key | {"task": params.task})
    return {
        "transitions": len(rollouts),
        "terminated": int(rollouts.terminated.sum()),
        "halted": int(rollouts.halted.sum()),
        "uncertainty_mean": float(rollouts.uncertainty.mean()),
    }


def _imagine_first(params: Params, root: Path, clone: Any) -> Any:
    """The clone's rollouts in the world model; their rate goes to the side file."""

    options, device = params.generate_rollouts, pick_device()
    model = load_world_model(root / WORLD_MODEL, fused=params.compile).to(device)
    generator = torch.Generator(device).manual_seed(params.seed)
    points = BranchPoints(load_dataset(root / DATASET), device)
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
    note_timing(root, "imagined_transitions_per_second", len(rollouts) / (time.perf_counter() - begin))
    return rollouts
