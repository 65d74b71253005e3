"""Gymnasium's Pendulum learned online, and what agents make of the log that this leaves.

`python -m tests.pendulum 0 1 2` measures the table of docs/finetuning.md, seed by seed.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.agents.sac import SAC, SACOptions
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.imagination.buffer import Imagination, ImaginedBatches
from envtf_lit.online.data import OnlineData
from envtf_lit.online.evaluation import Evaluation
from envtf_lit.pipeline.train_policy import transition_data
from envtf_lit.policy import Policy, RandomPolicy
from envtf_lit.robots.environments import robot_in
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.training import Curves, Guard, trained
from envtf_lit.world_models.fit import fit_world_model
from envtf_lit.world_models.options import EnsembleOptions
from envtf_lit.world_models.store import load_world_model

PENDULUM = robot_in("Pendulum-v1")
ROWS, FIRST, EPISODES = 20_000, 1_000, 20
SMALL: dict[str, Any] = dict(hidden=(64, 64), batch_size=128)
ONLINE: dict[str, Any] = dict(
    discount=0.99, n_step=1, return_temperature=None, warm_start=0.0, actor_schedule="constant", actor_average=0.01
)
RATES: dict[str, Any] = dict(actor_learning_rate=0.001, critic_learning_rate=0.001)
# five steps' rewards, all rows alike: the return of an episode tells where the pendulum hung at first
SHARED: dict[str, Any] = dict(discount=0.99, n_step=5, return_temperature=None)
OFFLINE: dict[str, dict[str, Any]] = {
    "bc": {},
    "td3_bc": {},
    "rebrac": {},
    "iql": {},
    "cql": {},
    "mopo": {"rollouts": {"branches": 2_000}},
}
ENSEMBLE = EnsembleOptions(
    members=4, elites=3, hidden=(64, 64), weight_decay=(0.0, 0.0, 0.0), updates=2_000, updates_per_epoch=500
)


def learn_online(seed: int, rows: int = ROWS) -> tuple[np.ndarray, OnlineData, Agent]:
    """Soft actor-critic from nothing, an update for each step: (epochs, 2) steps and mean return, data, and agent."""
    updates, per_epoch = rows - FIRST, 1_000
    options = SACOptions(updates=updates, updates_per_epoch=per_epoch, **SMALL, **ONLINE, **RATES)
    data = OnlineData(
        environment="Pendulum-v1",
        first_steps=FIRST,
        evaluation_episodes=EPISODES,
        seed=seed,
        batch_size=options.batch_size,
        steps_per_epoch=per_epoch // 10,
        discount=options.discount,
        n_step=options.n_step,
    )
    torch.manual_seed(seed)
    agent = SAC(3, 1, options, action_low=data.action_low, action_high=data.action_high, seed=seed)
    quiet: dict[str, Any] = dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary"), False)
    curves, epochs = Curves(), updates // per_epoch
    trainer = L.Trainer(max_epochs=epochs, accelerator="cpu", callbacks=[Evaluation(), Guard(), curves], **quiet)
    trainer.fit(agent, datamodule=data)
    points = [(row.get("train/env_steps", 0.0), row["val/return"]) for row in curves.rows]
    return np.array(points), data, agent


def mean_return(policy: Policy, seed: int = 0) -> float:
    """Of twenty episodes."""
    return float(evaluate_policy(policy, PENDULUM, episodes=EPISODES, seed=seed, progress=False).returns.mean())


def random_return() -> float:
    """Of uniform actions."""
    limit = torch.tensor([2.0])
    torch.manual_seed(0)
    return mean_return(RandomPolicy(-limit, limit))


def save_log(data: OnlineData, path: Path) -> OfflineDataset:
    """What was lived through, with a split."""
    save_dataset(data.lived().with_split(0.1, 0), path)
    return load_dataset(path)


def learn_offline(algorithm: str, log: Path, work: Path, seed: int, updates: int = 4_000) -> float:
    """An algorithm with its own options as they are by default, on a log alone: its mean return."""
    cls, own = ALGORITHMS[algorithm], dict(OFFLINE[algorithm])
    if "rollouts" in own:
        own["rollouts"] = type(cls.Options().rollouts)(**own["rollouts"])  # pyright: ignore[reportAttributeAccessIssue]
    options = cls.Options(updates=updates, updates_per_epoch=500, **SMALL, **SHARED, **RATES, **own)
    data = transition_data(log, options, seed=seed)
    source = None if options.world_model == NO_WORLD_MODEL else imagination(log, work, options, seed)
    torch.manual_seed(seed)
    agent = cls(3, 1, options, action_low=data.action_low, action_high=data.action_high, seed=seed, source=source)
    kwargs: dict[str, Any] = dict(run=work / "run", target=None, precision="fp32", progress=False, validate=False)
    with trained(agent, data, epochs=updates // 500, **kwargs):
        return mean_return(agent.average_actor)


def imagination(log: Path, work: Path, options: Any, seed: int) -> ImaginedBatches:
    """An ensemble that learned the log, with a source of rows imagined in it; a pendulum never terminates."""
    folder = work / f"ensemble-{seed}"
    if not folder.exists():
        kwargs: dict[str, Any] = dict(precision="fp32", compile=False, settings={}, root=work, progress=False)
        fit_world_model(ENSEMBLE, log, folder, seed=seed, **kwargs)
    never = lambda states: torch.zeros(states.shape[:-1], dtype=torch.bool)  # noqa: E731
    imagined = Imagination(load_world_model(folder), load_dataset(log), never, options.rollouts)
    limit = torch.tensor([2.0])
    stored = imagined.rollouts(RandomPolicy(-limit, limit), torch.Generator().manual_seed(seed))
    return ImaginedBatches(
        imagined,
        stored,
        real_ratio=options.real_ratio,
        refresh_every=options.refresh_every,
        discount=options.discount,
    )


def main(seeds: list[int]) -> None:
    """Prints what each seed reached."""
    random = random_return()
    print(f"random {random:.0f}")
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            curves, data, agent = learn_online(seed)
            expert, work = mean_return(agent.average_actor), Path(folder, str(seed))
            print(seed, "online", curves.round().tolist(), flush=True)
            print(seed, f"expert {expert:.0f}", f"log {save_log(data, work / 'log.h5').episode_returns.mean():.0f}")
            for algorithm in OFFLINE:
                reached = learn_offline(algorithm, work / "log.h5", work, seed)
                print(seed, algorithm, f"{reached:.0f} {(reached - random) / (expert - random):.3f}", flush=True)


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]])
