"""The stage `train_policy`: trains a policy on data alone, or on data and imagination."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.combo import MixingOptions
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.agents.store import publish_policy
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.options import UPDATES_PER_STEP
from envtf_lit.devices import pick_device
from envtf_lit.imagination.buffer import Imagination, ImaginedBatches
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.dataset import dataset_of
from envtf_lit.pipeline.params import Params, algorithm_of, one_of
from envtf_lit.pipeline.stage import (
    POLICIES,
    WORLD_MODELS,
    robot_of,
    rollouts_file,
    run_settings,
    run_stage,
    unseen,
)
from envtf_lit.progress import note
from envtf_lit.training import Curves, run_folder, trained
from envtf_lit.world_models.fit import REACH, known_reach
from envtf_lit.world_models.observed import as_observed
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination_head import termination_rule


def train_policy(
    params: Params,
    root: Path = Path("."),
    *,
    name: str | None = None,
    callbacks: Sequence[Callback] = (),
    progress: bool = True,
) -> dict[str, Any]:
    """Trains a policy: `models/policy/NAME/`.

    Args:
        params: all options.
        root: of the project.
        name: of the section below `train_policy`; None where there is one alone.
        callbacks: of `trained`.
        progress: shows a bar.

    Returns:
        The last row of the training's curves.

    Raises:
        UserError: no such section, or something that the stage reads is missing.
    """
    name = one_of("train_policy", params.train_policy, name)
    options, target = params.train_policy[name], root / POLICIES / name
    with run_stage(f"train_policy_{name}", params, root):
        algorithm = ALGORITHMS[algorithm_of(options)]
        if isinstance(options, MixingOptions):
            options = within_reach(options, root / WORLD_MODELS / options.world_model)
        dataset = dataset_of(params, root)
        held_out = {"held_out": params.download.held_out} if algorithm.watches else unseen(params)
        data = transition_data(dataset, options, seed=params.seed, **held_out)
        agent = algorithm(
            data.observation_dim,
            data.action_dim,
            options,
            action_low=data.action_low,
            action_high=data.action_high,
            seed=params.seed,
            source=imagined_batches(params, root, options, data) if algorithm.imagines else None,
        )
        inputs = [dataset]
        if algorithm.imagines:
            inputs += [root / WORLD_MODELS / options.world_model, rollouts_file(root, options.world_model)]
        settings = run_settings(params, options) | {"algorithm": algorithm_of(options)}
        with trained(
            agent,
            data,
            run=run_folder(root, f"train_policy_{name}", settings, inputs),
            target=target,
            epochs=options.updates // options.updates_per_epoch,
            precision=params.precision,
            progress=progress,
            validate=False,
            callbacks=callbacks,
        ) as curves:
            return _publish(target, agent, curves, settings)


def _publish(target: Path, agent: Agent, curves: Curves, settings: dict[str, Any]) -> dict[str, Any]:
    return publish_policy(
        target,
        agent.average_actor,
        curves,
        curves.rows[-1],
        settings,
        critics=agent.published_critics(),
        records=agent.records(),
        companions=agent.companions(),
    )


def within_reach(options: MixingOptions, model: Path) -> MixingOptions:
    """The options with paths no longer than the world model's held-out reach, as its folder says; a note if that cuts.

    Args:
        options: of a policy that imagines.
        model: folder of the world model; one of an earlier version says nothing, and nothing is cut.
    """
    steps = known_reach(model)
    if steps is None or (cut := options.within(steps)) == options:
        return options
    asked, now = options.path_lengths, cut.path_lengths
    changes = [f"{name} is {now[name]}, not {length}" for name, length in asked.items() if now[name] != length]
    note(
        f"{model} reaches {steps} step{'s' * (steps != 1)} before its error passes 0.1 ({REACH}), so paths are "
        f"shortened: {' and '.join(changes)}; for longer ones train the model on more updates or more data."
    )
    return cut


def transition_data(dataset: Path, options: PolicyOptions, *, seed: int, held_out: float = 0.0) -> TransitionData:
    """The rows that such options are trained on.

    Args:
        dataset: HDF5 or NPZ.
        options: of the policy.
        seed: of the draws, and of the split.
        held_out: share of the episodes left out.
    """
    return TransitionData(
        str(dataset),
        batch_size=options.batch_size,
        steps_per_epoch=options.updates_per_epoch // UPDATES_PER_STEP,
        discount=options.discount,
        n_step=options.n_step,
        return_temperature=options.return_temperature,
        fewest_episodes=options.fewest_episodes,
        held_out=held_out,
        seed=seed,
    )


def imagined_batches(params: Params, root: Path, options: Any, data: TransitionData) -> ImaginedBatches:
    """The source of imagined rows that a policy's options name."""
    device, folder = pick_device(), root / WORLD_MODELS / options.world_model
    imagination = Imagination(
        as_observed(load_world_model(folder, fused=params.compile, dataset=data.dataset).to(device), robot_of(params)),
        data.dataset,
        termination_rule(params.task, folder, device),
        options.rollouts,
        device,
        weights=data.weights,  # as the real rows are drawn
    )
    return ImaginedBatches(
        imagination,
        load_rollouts(rollouts_file(root, options.world_model)),
        real_ratio=options.real_ratio,
        refresh_every=options.refresh_every,
        discount=options.discount,
    )
