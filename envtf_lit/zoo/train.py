"""Training of the zoo's behaviour policies with sbx (the extra `behaviour`): snapshots of the weights along the way."""

import math
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import MofNCompleteColumn, TextColumn
from safetensors.torch import save

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.errors import UserError, missing_extra
from envtf_lit.files import read_json, replacing, write_json
from envtf_lit.progress import progress_bar
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import Robot
from envtf_lit.zoo.snapshots import Snapshot, load_snapshot, read_series

EPISODES = 20  # of deterministic actions, by which a snapshot is measured
WARM_UP_STEPS = 5_000  # uniform random actions
ARCHITECTURE = {"hidden": [128, 128], "log_std_min": -20.0}
# snapshots lie closer where returns climb fast: (up to this step, every so many)
SCHEDULE = ((1, WARM_UP_STEPS + 2_500), (25_000, 2_500), (50_000, 5_000), (100_000, 10_000), (float("inf"), 25_000))
SETTLED = "the last snapshot is the mean"
RENORM_EPSILON = 0.001  # of sbx's BatchRenorm


@dataclass(frozen=True)
class Recipe:
    """A learner's settings.

    Attributes:
        algorithm: class in sbx.
        environments: that are stepped together.
        arguments: of the class.
        words: the same for readers.
    """

    algorithm: str
    environments: int
    arguments: dict[str, Any]
    words: str


RECIPES = {
    "crossq": Recipe(
        "CrossQ",
        8,
        {
            "batch_size": 128,
            "train_freq": 4,
            "gradient_steps": 32,
            "policy_kwargs": {"net_arch": {"pi": [128, 128], "qf": [256, 256]}, "renorm_warmup_steps": 50_000},
        },
        "CrossQ (sbx-rl): actor of two hidden layers of 128 ReLU units with batch renormalisation (folded into the "
        "weights), critics of two of 256, batch 128, 32 updates per 32 steps in 8 environments, learning rate 1e-3",
    ),
    "sac": Recipe(
        "SAC",
        1,
        {
            "batch_size": 128,
            "train_freq": 16,
            "gradient_steps": 16,
            "learning_rate": 3e-4,
            "policy_kwargs": {"net_arch": [128, 128]},
        },
        "SAC (sbx-rl): actor and critics of two hidden layers of 128 ReLU units, batch 128, 16 updates per 16 steps, "
        "learning rate 3e-4",
    ),
}


def train(robot: Robot, out: Path, *, algorithm: str, steps: int, seed: int, progress: bool = True) -> Path:
    """Trains one robot's learner and writes its series, from which `envtf zoo build --zoo OUT` makes datasets.

    After every snapshot the series on disk is whole, so an interrupted run leaves a shorter one. It cannot be resumed:
    a learner is its replay buffer and optimisers too, and those would have to be kept as pickles.

    Args:
        robot: one of the four.
        out: the zoo's folder; the series goes to `<out>/<robot>/`.
        algorithm: one of `RECIPES`.
        steps: environment steps in all.
        seed: of networks, environments and actions.
        progress: shows a bar with the time left.

    Returns:
        The series' folder.

    Raises:
        UserError: sbx is missing, or the folder holds a series already.
    """
    folder, recipe = out / robot.name, RECIPES[algorithm]
    if os.path.lexists(folder):
        raise UserError(f"{folder} exists already: name another --out, or delete it to train anew.")
    if steps <= WARM_UP_STEPS:
        raise UserError(
            f"{steps} steps are no training: the first {WARM_UP_STEPS} are the random warm-up; ask for more."
        )
    model = _learner(robot, recipe, seed)
    snapshots: list[Snapshot] = []
    shown = (MofNCompleteColumn(), TextColumn("return {task.fields[reached]:.0f}"))
    with progress_bar(f"Training {robot.name}", steps, *shown, visible=progress, reached=0.0) as update:
        while model.num_timesteps < steps:
            model.learn(min(_stretch(model.num_timesteps), steps - model.num_timesteps), reset_num_timesteps=False)
            snapshots.append(_keep(_actor(robot, model), robot, model.num_timesteps, folder))
            write_json(folder / "zoo.json", _contents(robot, recipe, seed, snapshots))
            update(completed=model.num_timesteps, reached=snapshots[-1].mean_return)
    return folder


def _stretch(step: int) -> int:
    """Steps from here to the next snapshot."""
    return next(every for until, every in SCHEDULE if step < until)


def _learner(robot: Robot, recipe: Recipe, seed: int) -> Any:
    # one core per robot: small matrices gain nothing from threads
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    try:
        import sbx  # pyright: ignore[reportMissingImports]
        from stable_baselines3.common.vec_env import DummyVecEnv  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise missing_extra("Training behaviour policies needs sbx-rl", "behaviour", error) from None
    environments = DummyVecEnv([robot.make] * recipe.environments)
    learner = getattr(sbx, recipe.algorithm)
    return learner("MlpPolicy", environments, seed=seed, learning_starts=WARM_UP_STEPS, **recipe.arguments)


def _actor(robot: Robot, model: Any) -> TanhGaussianActor:
    """The learner's present actor as ours."""
    state = model.policy.actor_state
    weights = flax_to_torch(state.params, getattr(state, "batch_stats", None))
    actor = TanhGaussianActor(robot.observation_dim, robot.action_dim, **ARCHITECTURE)
    actor.load_state_dict(actor.state_dict() | weights)
    return actor.eval()


def flax_to_torch(params: Any, statistics: Any | None) -> dict[str, torch.Tensor]:
    """An sbx actor's arrays as a `TanhGaussianActor`'s weights.

    Args:
        params: `Dense_0`, `Dense_1` (hidden), `Dense_2` (mean), `Dense_3` (log standard deviation), each with `kernel`
            (inputs, outputs) and `bias`; of CrossQ also `BatchRenorm_0` to `_2`, each before the layer of its number.
        statistics: their running `mean` and `var`; None where the actor has no normalisation. What they do to a
            layer's input is linear, `x' = scale (x - mean) / sqrt(var + eps) + bias`, and goes into its weights.
    """
    params = params.get("params", params)
    both = {
        name: np.concatenate([params[head][name] for head in ("Dense_2", "Dense_3")], -1) for name in ("kernel", "bias")
    }
    weights = {}
    for index, layer in enumerate((params["Dense_0"], params["Dense_1"], both)):
        kernel, bias = (np.asarray(layer[name], dtype=np.float64) for name in ("kernel", "bias"))
        if statistics is not None:
            norm, running = params[f"BatchRenorm_{index}"], statistics[f"BatchRenorm_{index}"]
            scale = np.asarray(norm["scale"], np.float64) / np.sqrt(
                np.asarray(running["var"], np.float64) + RENORM_EPSILON
            )
            bias = bias + (np.asarray(norm["bias"]) - np.asarray(running["mean"]) * scale) @ kernel
            kernel = scale[:, None] * kernel
        weights[f"net.{2 * index}.weight"] = torch.tensor(kernel.T, dtype=torch.float32)
        weights[f"net.{2 * index}.bias"] = torch.tensor(bias, dtype=torch.float32)
    return weights


def _keep(actor: TanhGaussianActor, robot: Robot, steps: int, folder: Path) -> Snapshot:
    """Writes a snapshot and measures it."""
    measured = evaluate_policy(actor, robot, episodes=EPISODES, seed=0, progress=False)
    with replacing(folder / f"{steps:07d}.safetensors") as temporary:
        temporary.write_bytes(save({name: tensor.contiguous() for name, tensor in actor.state_dict().items()}))
    return Snapshot(
        steps,
        round(float(measured.returns.mean()), 3),
        round(float(measured.returns.std()), 3),
        round(float(measured.lengths.mean()), 1),
    )


def average_last_snapshots(robot: Robot, zoo: Path, *, last: int = 3, noise: float = 0.5) -> Snapshot:
    """Replaces a series' last snapshot by the mean of the last ones' weights, with a smaller standard deviation.

    A constant learning rate leaves a learner circling its optimum; the mean of late weights lies nearer to it
    (stochastic weight averaging, Izmailov et al. 2018). Maximum-entropy learners end with more noise than their return
    would choose.

    Args:
        robot: whose series.
        zoo: the folder that `train` wrote it to.
        last: snapshots that are averaged.
        noise: factor of the standard deviations, above 0.

    Returns:
        The new last snapshot; `zoo.json` tells what it is.

    Raises:
        UserError: there is no such series, it has fewer snapshots, or was settled before.
    """
    series = read_series(robot, zoo)
    if not 1 <= last <= len(series.snapshots) or noise <= 0:
        raise UserError(
            f"{last} snapshots and {noise:g} times the noise cannot be had: {series.folder} has "
            f"{len(series.snapshots)} snapshots, and a factor is above 0."
        )
    if SETTLED in series.trained_with:
        raise UserError(f"{series.folder} was settled before: its last snapshot is an average already.")
    actors = [load_snapshot(series, snapshot.steps) for snapshot in series.snapshots[-last:]]
    actor = TanhGaussianActor(robot.observation_dim, robot.action_dim, **series.architecture).eval()
    weights = {name: torch.stack([a.state_dict()[name] for a in actors]).mean(0) for name in actor.state_dict()}
    actor.load_state_dict(weights)
    output = actor.net[-1]
    assert isinstance(output, torch.nn.Linear)
    output.bias.data[robot.action_dim :] += math.log(noise)
    content = read_json(series.folder / "zoo.json")
    content["trained_with"] += f"; {SETTLED} of the last {last}'s weights, with {noise:g} times the standard deviation"
    with replacing(series.folder) as folder:  # weights and what is said of them change together
        shutil.copytree(series.folder, folder, symlinks=True)
        kept = _keep(actor, robot, series.snapshots[-1].steps, folder)
        content["snapshots"][-1] = asdict(kept)
        write_json(folder / "zoo.json", content)
    return kept


def _contents(robot: Robot, recipe: Recipe, seed: int, snapshots: list[Snapshot]) -> dict[str, Any]:
    return {
        "robot": robot.name,
        "env_id": robot.env_id,
        "trained_with": f"{recipe.words}, {WARM_UP_STEPS:,} random steps to begin with, seed {seed}",
        "returns": f"mean, standard deviation and mean length of {EPISODES} episodes of deterministic actions, seeds "
        f"1000 to {999 + EPISODES}",
        "architecture": ARCHITECTURE,
        "warm_up_steps": WARM_UP_STEPS,
        "snapshots": [asdict(snapshot) for snapshot in snapshots],
    }
