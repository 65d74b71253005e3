"""The stage `train_policy`: trains a policy on data alone, or on data and imagination."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from envtf_lit.agents.cql import CQL
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.store import publish_policy
from envtf_lit.data.loaders import TransitionData, return_weights
from envtf_lit.files import pick_device
from envtf_lit.imagination.rollouts import Imagination
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import (
    DATASET,
    POLICIES,
    ROLLOUTS,
    WORLD_MODEL,
    run_settings,
    run_stage,
    unseen,
)
from envtf_lit.training import run_folder, trained
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination import termination_rule


def train_policy(
    params: Params, root: Path = Path("."), *, algorithm: str = "et_cql", progress: bool = True
) -> dict[str, Any]:
    """Trains `cql` (data alone) or `et_cql` (data and imagination): `models/policy/<algorithm>/`."""

    options: PolicyOptions = getattr(params.train_policy, algorithm)
    with run_stage(f"train_policy_{algorithm}", params, root):
        data = TransitionData(
            str(root / DATASET),
            batch_size=options.batch_size,
            updates_per_step=options.updates_per_step,
            steps_per_epoch=options.updates_per_epoch // options.updates_per_step,
            discount=options.discount,
            n_step=options.n_step,
            return_temperature=options.return_temperature,
            **unseen(params),
            seed=params.seed,
        )
        agent = CQL(
            data.observation_dim,
            data.action_dim,
            options,
            action_low=data.action_low,
            action_high=data.action_high,
            seed=params.seed,
        )
        inputs, monitor = [root / DATASET], None
        if options.imagination is not None:
            _give_imagination(agent, params, root, data.dataset)
            inputs += [root / WORLD_MODEL, root / ROLLOUTS]
            monitor = "val/imagined_return" if options.imagination.selection_episodes > 0 else None
        key = run_settings(params, asdict(options)) | unseen(params)
        target = root / POLICIES / algorithm
        with trained(
            agent,
            data,
            run=run_folder(root, f"train_policy_{algorithm}", key, inputs),
            target=target,
            epochs=options.updates // options.updates_per_epoch,
            precision=params.precision,
            progress=progress,
            monitor=monitor,
            mode="max",
            validate=False,
        ) as curves:
            kept = max(curves.rows, key=lambda row: row[monitor]) if monitor else curves.rows[-1]
            return publish_policy(target, agent.average_actor, curves, kept, key)


def _give_imagination(agent: Any, params: Params, root: Path, dataset: Any) -> None:
    """Hands an agent the world model and the stored rollouts."""
    device = pick_device()
    model = load_world_model(root / WORLD_MODEL, fused=params.compile).to(device)
    temperature = agent.options.return_temperature
    weights = None if temperature is None else return_weights(dataset, temperature)  # as the real rows are drawn
    imagination = Imagination(
        model,
        dataset,
        termination_rule(params.task, root / WORLD_MODEL, device),
        agent.options.imagination,
        device,
        weights,
    )
    agent.dream_with(imagination, load_rollouts(root / ROLLOUTS), reward_std=float(dataset.rewards.std()))
