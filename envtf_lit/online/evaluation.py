"""What an agent that learns online reaches, epoch by epoch, in episodes that it does not learn from."""

import copy
import math
from dataclasses import replace
from typing import cast

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from envtf_lit.agents.agent import Agent
from envtf_lit.online.data import OnlineData
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.training import Curves


class Evaluation(Callback):
    """Plays episodes with the averaged actor's deterministic actions before the first epoch and after each.

    Logs their mean return, `val/return`, and of a robot whose random and expert returns are known `val/score`; of the
    actor's own episodes that ended in the epoch `train/episode_return`, and the steps so far, `train/env_steps`. The
    curves' row of epoch 0 is where the policy began. Values may be as large as the rewards that were met allow.
    """

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.current_epoch == 0:
            callbacks: list[Callback] = trainer.callbacks  # pyright: ignore[reportAttributeAccessIssue]
            for curves in (callback for callback in callbacks if isinstance(callback, Curves)):
                curves.rows.append({"epoch": 0} | self._reached(trainer, cast(Agent, pl_module)))

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        agent, data = cast(Agent, pl_module), _data_of(trainer)
        known, met = agent.log_returns, data.replay.largest_reward / (1.0 - agent.options.discount)
        agent.log_returns = replace(known, largest=max(known.largest, met))
        logs = self._reached(trainer, agent) | {"train/env_steps": float(data.interaction.steps)}
        if finished := data.interaction.finished:
            logs["train/episode_return"] = sum(finished) / len(finished)
            finished.clear()
        agent.log_dict(logs)

    def _reached(self, trainer: L.Trainer, agent: Agent) -> dict[str, float]:
        data = _data_of(trainer)
        if data.evaluation_episodes == 0 or trainer.fast_dev_run:  # pyright: ignore[reportAttributeAccessIssue]
            return {}
        actor = copy.deepcopy(agent.average_actor).cpu()
        with torch.autocast("cpu", enabled=False):
            found = evaluate_policy(
                actor, data.robot, episodes=data.evaluation_episodes, seed=data.seed, progress=False
            )
        values = {"val/return": float(found.returns.mean()), "val/score": float(found.scores.mean())}
        return {name: value for name, value in values.items() if math.isfinite(value)}


def _data_of(trainer: L.Trainer) -> OnlineData:
    return trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
