"""The actor climbs its imagined return: the gradient runs through the world model, step by step."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from envtf_lit.agents.networks import StateValue
from envtf_lit.imagination.options import ValueGradientOptions
from envtf_lit.imagination.rollouts import Imagination
from envtf_lit.policy import TanhGaussianActor

VALUE_BATCH = 256  # states per gradient step of the state value
HIDDEN = (256, 256)  # its units


@dataclass(frozen=True)
class Paths:
    """H consecutive steps of B imagined rollouts; what comes after a fall means nothing.

    Attributes:
        observations, next_observations: (H, B, S).
        actions: (H, B, A).
        rewards: (H, B), in units of the agent's returns.
        fell: (H, B) bool, the robot's rule at each next observation.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    fell: Tensor

    @property
    def alive(self) -> Tensor:
        """(H + 1, B), 1 where the robot has not fallen before that step; the last row is what outlives the path."""
        standing = (~self.fell).float().cumprod(0)
        return torch.cat([torch.ones_like(standing[:1]), standing])


class ValueGradient(nn.Module):
    """Policy improvement by the gradient of imagined returns (SVG, Heess et al. 2015; as in SHAC, Xu et al. 2022).

    Imagined robots are carried on from update to update, `horizon` steps at a time, so that the actor meets the states
    that it leads to itself. A state value, learned on those very paths, stands for what follows a path.

    Args:
        observation_dim: S.
        options: of the paths and of the optimisation.
    """

    def __init__(self, observation_dim: int, options: ValueGradientOptions) -> None:
        super().__init__()
        self.options = options
        self.value = StateValue(observation_dim, hidden=HIDDEN)
        self.target_value = copy.deepcopy(self.value).requires_grad_(False)
        self.restart()

    def restart(self) -> None:
        """Forgets the rollouts under way; the next path begins at real states."""
        self._histories: tuple[Tensor, Tensor, Tensor] | None = None

    def paths(
        self, actor: TanhGaussianActor, imagination: Imagination, scale: Tensor, generator: torch.Generator
    ) -> Paths:
        """The next `horizon` steps of all rollouts under the actor's sampled actions, differentiable in the actor.

        Each path runs in a world model of its own, drawn from the posterior as `imagination.options.posterior` says.

        Args:
            scale: by which rewards are divided.
            generator: of starts, worlds, actions and next states.
        """
        model, options = imagination.model, imagination.options
        if self._histories is None:
            self._histories = imagination.starts.draw(self.options.rollouts, options.history, generator)
            self._age = torch.zeros_like(self._histories[2])
        with torch.no_grad():
            state = model.init(*self._histories, posterior=options.posterior, generator=generator)
        steps = []
        for _ in range(self.options.horizon):
            observation = model.current(state)
            action, _ = actor.sample(observation, generator=generator)
            state, prediction = model.step(state, action, mode=options.mode, generator=generator)
            following = prediction.observation
            steps.append((observation, action, prediction.reward / scale, following, imagination.terminated(following)))
        paths = Paths(*(torch.stack(column) for column in zip(*steps, strict=True)))
        self._carry_on(paths, imagination, generator)
        return paths

    @torch.no_grad()
    def _carry_on(self, paths: Paths, imagination: Imagination, generator: torch.Generator) -> None:
        """Where the next paths begin: at the ends of these, but at real states where robots fell or grew old."""
        history, horizon = imagination.options.history, self.options.horizon
        observations = torch.cat([paths.observations[horizon - history :], paths.next_observations[-1:]])
        actions = paths.actions[horizon - history :]
        fresh = imagination.starts.draw(self.options.rollouts, history, generator)
        self._age += horizon
        ended = paths.fell.any(0) | (self._age >= self.options.max_steps)  # (B,)
        self._age[ended] = 0
        ends = observations.transpose(0, 1), actions.transpose(0, 1), torch.full_like(fresh[2], history + 1)
        self._histories = (
            torch.where(ended[:, None, None], fresh[0], ends[0]),
            torch.where(ended[:, None, None], fresh[1], ends[1]),
            torch.where(ended, fresh[2], ends[2]),
        )

    def imagined_return(self, paths: Paths, discount: float) -> Tensor:
        """(B,) `sum_k discount^k r_k + discount^H V(s_H)`, up to the fall (Xu et al. 2022, equation 5)."""
        weights = discount ** torch.arange(len(paths.rewards) + 1, device=paths.rewards.device)[:, None] * paths.alive
        return (weights[:-1] * paths.rewards).sum(0) + weights[-1] * self.value(paths.next_observations[-1])

    @torch.no_grad()
    def value_targets(self, paths: Paths, discount: float) -> Tensor:
        """(H, B) TD(lambda) targets under the slow state value (Xu et al. 2022, equations 6 and 7)."""
        later = self.target_value(paths.next_observations)
        target, targets = later[-1], torch.empty_like(paths.rewards)
        for t in reversed(range(len(targets))):
            target = (1.0 - self.options.trace) * later[t] + self.options.trace * target
            target = targets[t] = paths.rewards[t] + discount * ~paths.fell[t] * target
        return targets

    def lessons(self, paths: Paths, discount: float, generator: torch.Generator) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches of states and their targets: all that was lived through, `value_passes` times in random order."""
        lived = paths.alive[:-1].flatten() > 0
        states = paths.observations.detach().flatten(0, 1)[lived]
        targets = self.value_targets(paths, discount).flatten()[lived]
        for _ in range(self.options.value_passes):
            order = torch.randperm(len(states), generator=generator, device=states.device)
            for rows in order.split(VALUE_BATCH):
                yield states[rows], targets[rows]

    def value_loss(self, observations: Tensor, returns: Tensor) -> Tensor:
        """`(V(s) - G)^2`, mean over the batch."""
        return (self.value(observations) - returns).square().mean()

    def rate(self, done: float) -> float:
        """Of the actor's learning rate after this share of the updates: up over the first tenth, then down to zero."""
        return min(10.0 * done, (1.0 - done) / 0.9)
