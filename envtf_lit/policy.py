"""Policies: the protocol that everything acting follows, and those that are saved in folders."""

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from envtf_lit.actors import POLICIES, Actor, kind_of
from envtf_lit.errors import UserError
from envtf_lit.model_folders import load_module, save_module


class Policy(Protocol):
    """Anything that acts: agents, behaviour policies, planners, exported models."""

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A) in the environment's own action range."""
        ...


@runtime_checkable
class StatefulPolicy(Policy, Protocol):
    """A policy that remembers the episodes it is in, such as a planner; its rows stay the same ones."""

    def reset(self) -> None:
        """Forgets them: others begin."""
        ...


def begin_episodes(policy: Policy) -> None:
    """Says that new episodes begin, to a policy that would remember the old ones."""
    if isinstance(policy, StatefulPolicy):
        policy.reset()


class RandomPolicy:
    """Uniform actions in the action space: the `random` tier and the learner's warm-up."""

    def __init__(self, action_low: Tensor, action_high: Tensor) -> None:
        self.action_low, self.action_high = action_low, action_high

    def act(self, observation: Tensor, deterministic: bool = False, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to uniform actions (B, A); `deterministic` changes nothing: it has no mode to return."""
        size = (len(observation), len(self.action_low))
        uniform = torch.rand(size, generator=generator, device=self.action_low.device)
        return self.action_low + uniform * (self.action_high - self.action_low)


class Predictor(Protocol):
    """What stable-baselines3's learners (and sbx's) have in common."""

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Observations (B, S) to actions (B, A)."""
        ...


class PredictingPolicy:
    """A learner of stable-baselines3 as a policy, for all that plays and scores policies.

    Args:
        learner: trained, on flat observations; what it draws comes from its own random numbers.
    """

    def __init__(self, learner: Predictor) -> None:
        self.learner = learner

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A); `generator` has nothing to draw here."""
        actions, _ = self.learner.predict(observation.cpu().numpy(), deterministic=deterministic)
        return torch.from_numpy(actions).to(observation.device)


def save_policy(folder: str | Path, actor: Actor) -> None:
    """Writes an actor as safetensors beside JSON, which names its kind."""
    save_module(folder, actor, kind=kind_of(actor), arguments=actor.arguments)


def load_policy(folder: str | Path, *, guarded: bool = True) -> Actor:
    """The policy saved in a folder, ready to `act`.

    Args:
        folder: that `save_policy` wrote.
        guarded: it refuses observations that are not finite, in `act` too, with a UserError: a robot whose sensor fails
            must not be sent NaN. That takes one look at the device for each call, so a world model's own states, which
            end their rollouts where they aren't finite, come without. Nor is it in what `torch.export` or a trace make.

    Raises:
        UserError: the folder is missing, damaged, or holds something that is not a policy, or one whose action limits
            are no finite range.
    """
    actor = load_module(folder, POLICIES)
    width = actor.action_high - actor.action_low
    if not ((width > 0) & width.isfinite()).all():
        raise UserError(
            f"{folder} holds action limits {actor.action_low.tolist()} and {actor.action_high.tolist()}: each low one "
            "must be less than its high one, and both finite; train the policy on data that say so."
        )
    if guarded:
        actor.register_forward_pre_hook(_refuse_unknown)
    return actor


def _refuse_unknown(actor: nn.Module, given: tuple[Tensor, ...]) -> None:
    tracing = torch.jit.is_tracing()  # pyright: ignore[reportPrivateImportUsage]
    if torch.compiler.is_compiling() or tracing:  # a graph raises nothing
        return
    observation = given[0]
    if observation.isfinite().all():
        return
    odd = (~observation.isfinite()).nonzero()[0]
    dimension, value = int(odd[-1]), float(observation[tuple(odd)])
    raise UserError(
        f"A policy is asked for an action where dimension {dimension} of the observation is {value}: the action would "
        "be no number; look why the sensor or the simulator gives none, and stop the robot there."
    )
