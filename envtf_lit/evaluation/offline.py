"""Estimates of policies without their environment: returns that the world model imagines, and agreement with the log.

An imagined return is an estimate by the world model. It stands beside the same model's estimate for the recorded
actions, whose true return the log knows: that difference is how wrong the estimate can be.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.horizon import HorizonReport
from envtf_lit.policy import Policy
from envtf_lit.world_models.forecast import Trajectories
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.unroll import unroll


@dataclass(frozen=True, eq=False)
class OfflineEstimate:
    """The estimate for one policy without its environment.

    Attributes:
        returns: (E,) float64, imagined return from the first state of each held-out episode, over as many steps as
            the recorded episode lasted.
        action_error: mean over steps and live dimensions of (deterministic action - recorded action)^2 / variance of
            the dimension in training; 1 is as good as the mean action.
    """

    returns: np.ndarray
    action_error: float


@dataclass(frozen=True, eq=False)
class OfflineEstimates:
    """The estimates for policies without their environment, and for the recorded actions.

    Attributes:
        recorded: (E,) float64, true returns of the held-out episodes.
        imagined: (E,) float64, returns that the model, on its own predictions, imagines of the recorded actions.
        lengths: (E,) int64, their steps.
        policies: by name.
    """

    recorded: np.ndarray
    imagined: np.ndarray
    lengths: np.ndarray
    policies: dict[str, OfflineEstimate]


def evaluate_offline(
    model: WorldModel, policies: Mapping[str, Policy], report: HorizonReport, training: OfflineDataset
) -> OfflineEstimates:
    """Estimates each policy in the world model, and compares its actions with the log's.

    Args:
        model: in eval mode, on the device of the report's trajectories.
        policies: by name; none may have learned from the held-out episodes.
        report: of the model on whole held-out episodes.
        training: gives the range of rewards and the spread of actions.
    """
    held_out = report.trajectories
    imagined = (_bounded(report.open_loop_forecast.mean[..., -1], training) * held_out.valid).sum(1)
    return OfflineEstimates(
        recorded=held_out.targets[..., -1].double().sum(1).cpu().numpy(),
        imagined=imagined.cpu().numpy(),
        lengths=held_out.lengths.cpu().numpy(),
        policies={
            name: OfflineEstimate(
                imagined_returns(model, policy, held_out, training), action_error(policy, held_out, training)
            )
            for name, policy in policies.items()
        },
    )


@torch.no_grad()
def imagined_returns(model: WorldModel, policy: Policy, held_out: Trajectories, training: OfflineDataset) -> np.ndarray:
    """Imagined returns (E,): of mean predictions under deterministic actions, each for as long as the record lasted.

    Rewards are cut to the range of the training data's, so that a model that runs away imagines no more than was ever
    paid.
    """
    first, no_actions = held_out.observations[:, :1], held_out.actions[:, :0]
    state = model.init(first, no_actions, torch.ones_like(held_out.lengths))
    total = torch.zeros(len(first), dtype=torch.float64, device=first.device)
    for step in unroll(
        model, state, lambda t, rows, observation: policy.act(observation, True), held_out.valid.shape[1]
    ):
        recorded = held_out.valid[:, step.index]  # (B,) whose episode still lasted
        total += torch.where(recorded, _bounded(step.prediction.reward, training), 0.0)
    return total.cpu().numpy()


def _bounded(rewards: Tensor, training: OfflineDataset) -> Tensor:
    low, high = float(training.rewards.min()), float(training.rewards.max())
    return rewards.double().nan_to_num(nan=low).clamp(low, high)


def action_error(policy: Policy, held_out: Trajectories, training: OfflineDataset) -> float:
    """See `OfflineEstimate.action_error`; zero where no action dimension varies."""
    spread, live = training.statistics.actions.std, training.statistics.actions.live
    chosen = policy.act(held_out.observations[held_out.valid], True).cpu().double()
    error = (chosen - held_out.actions[held_out.valid].cpu().double())[:, live] / spread[live]
    return float(error.square().mean()) if bool(live.any()) else 0.0
