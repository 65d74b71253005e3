"""Batches of real and imagined rows: rollouts of the current policy, the newest kept in a ring."""

import torch
from torch import Tensor, nn

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.imagination.rollouts import Rollouts, Rule, imagine
from envtf_lit.policy import Policy
from envtf_lit.world_models.interface import Prediction, WorldModel

Batch = dict[str, Tensor]
ROUNDS_KEPT = 3  # of rollouts: the newest rows that a ring holds


class Imagination:
    """A world model at an agent's service, and the real states that its rollouts begin at.

    Args:
        model: any world model, on `device`.
        dataset: gives the states to branch from.
        terminated: the robot's rule.
        options: of the rollouts.
        device: where states go.
        weights: (N,) chances of each row to be branched from; None draws uniformly.
    """

    def __init__(
        self,
        model: WorldModel,
        dataset: OfflineDataset,
        terminated: Rule,
        options: RolloutOptions,
        device: torch.device | str = "cpu",
        weights: Tensor | None = None,
    ) -> None:
        self.model, self.terminated, self.options = model, terminated, options
        self.starts = BranchPoints(dataset, device, weights)
        self.reward_std = float(dataset.rewards.std())
        self.reward_range = float(dataset.rewards.min()), float(dataset.rewards.max())
        lengths = dataset.episode_lengths
        self.longest_recorded = int(lengths.max())
        self.cut_short = not bool(dataset.terminated[dataset.episode_ends[lengths.argmax()] - 1])

    def rollouts(self, policy: Policy, generator: torch.Generator) -> Rollouts:
        """New branched rollouts under the policy's sampled actions, in fp32 whatever the precision around it.

        In bf16 the noise of a hidden token points where no training token did: it would pass for novelty, and for
        epistemic variance.
        """
        o = self.options
        with torch.autocast(self.starts.starts.device.type, enabled=False):
            return imagine(
                self.model,
                policy,
                self.starts.draw(o.branches, o.history, generator),
                horizon=o.horizon,
                expansion=o.value_expansion,
                terminated=self.terminated,
                novelty_limit=o.novelty_limit,
                mode=o.mode,
                posterior=o.posterior,
                generator=generator,
            )

    def longest(self, otherwise: int) -> int:
        """Steps of an episode: of the longest, if that was cut short; if it fell, others may last `otherwise`."""
        return self.longest_recorded if self.cut_short else max(self.longest_recorded, otherwise)

    def overpaid(self, prediction: Prediction) -> Tensor:
        """(B,) bool, whether more than any recorded reward is promised, and not by its noise alone.

        Where a reward has a bound that good policies stay at, noise alone passes it at every other step.
        """
        return prediction.mean[:, -1] - prediction.aleatoric[:, -1] > self.reward_range[1]

    def charged(self, rollouts: Rollouts) -> Tensor:
        """(H, B) rewards less the penalty `weight * std(r) * u`, std(r) over the data; differentiable in the states."""
        weight = self.options.penalty * self.reward_std
        return rollouts.rewards - weight * rollouts.uncertainty if weight > 0 else rollouts.rewards


class Ring(nn.Module):
    """The newest `capacity` imagined transitions; the oldest leave first. Part of checkpoints.

    Args:
        observation_dim: S.
        action_dim: A.
        capacity: transitions.
    """

    count: Tensor

    def __init__(self, observation_dim: int, action_dim: int, capacity: int) -> None:
        super().__init__()
        self.capacity = capacity
        self.widths = dict(
            observations=(observation_dim,),
            actions=(action_dim,),
            rewards=(),
            next_observations=(observation_dim,),
            following_observations=(observation_dim,),
            discounts=(),
        )
        for name, shape in self.widths.items():
            self.register_buffer(name, torch.zeros(capacity, *shape))
        self.register_buffer("count", torch.zeros((), dtype=torch.long))  # transitions ever added

    def __len__(self) -> int:
        return min(int(self.count), self.capacity)

    def add(self, transitions: Batch) -> None:
        """Writes all transitions, over the oldest ones if need be."""
        number, start = len(transitions["rewards"]), int(self.count)
        kept = torch.arange(max(0, number - self.capacity), number, device=self.count.device)
        slots = (start + kept) % self.capacity
        for name in self.widths:
            self.get_buffer(name)[slots] = transitions[name][kept].to(self.count.device, torch.float32)
        self.count += number

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """Uniform transitions, each column (count, …)."""
        rows = torch.randint(len(self), (count,), generator=generator, device=self.count.device)
        return {name: getattr(self, name)[rows] for name in self.widths}


class ImaginedBatches(nn.Module):
    """A source of mixed batches: `1 - real_ratio` of each batch's rows are imagined ones.

    Attributes:
        cut_share: of the round of rollouts that the last `mix` began with, those halted where the model had left what
            it knows; None where it began with none.

    Args:
        imagination: where new rollouts come from.
        stored: rollouts to begin with.
        real_ratio: share of real rows in each batch, in (0, 1].
        refresh_every: updates between two rounds of new rollouts under the current policy; 0 keeps the stored ones.
        discount: of future rewards, per step.
    """

    reward_scale: Tensor

    def __init__(
        self, imagination: Imagination, stored: Rollouts, *, real_ratio: float, refresh_every: int, discount: float
    ) -> None:
        super().__init__()
        self.imagination, self.stored, self.discount = imagination, stored, discount
        self.real_ratio, self.refresh_every = real_ratio, refresh_every
        o = imagination.options
        capacity = ROUNDS_KEPT * o.branches * o.horizon if refresh_every else len(stored)
        self.ring = Ring(stored.observations.shape[-1], stored.actions.shape[-1], max(1, capacity))
        self.register_buffer("reward_scale", torch.ones(()))  # rewards are divided by it
        self.cut_share: Tensor | None = None

    def begin(self, reward_scale: Tensor) -> None:
        """Takes the agent's reward scale, and the stored rollouts into the ring."""
        self.reward_scale.copy_(reward_scale)
        self.ring.count.zero_()
        self.add_rollouts(self.stored, horizon=len(self.stored.valid))  # all of them, whatever the policy's own horizon

    def mix(self, batch: Batch, done: int, policy: Policy, generator: torch.Generator) -> Batch:
        """Replaces the last rows of a real batch by imagined ones; `real` (B,) marks what is real.

        Args:
            batch: (B, …) columns of the log.
            done: updates with mixed batches before this one.
            policy: acts in new rollouts.
            generator: of rollouts and rows.
        """
        self.cut_share = None
        if self.refresh_every > 0 and done % self.refresh_every == 0:
            rollouts = self.imagination.rollouts(policy, generator)
            self.cut_share = rollouts.halted.any(0).float().mean()
            self.add_rollouts(rollouts, horizon=self.imagination.options.horizon)
        kept = round(self.real_ratio * len(batch["real"]))
        imagined = self.ring.draw(len(batch["real"]) - kept, generator)
        imagined["real"] = torch.zeros_like(imagined["rewards"])
        return {name: torch.cat([batch[name][:kept], column]) for name, column in imagined.items()}

    def add_rollouts(self, rollouts: Rollouts, *, horizon: int) -> None:
        """Puts the first `horizon` steps into the ring, rewards less the penalty."""
        rewards = self.imagination.charged(rollouts) / self.reward_scale
        if self.imagination.options.value_expansion > 0:
            total, end, weight = rollouts.returns(rewards, self.discount)
        else:
            weight = self.discount * (~rollouts.terminated).float()
            total, end = rewards, rollouts.next_observations
        columns = dict(
            observations=rollouts.observations,
            actions=rollouts.actions,
            rewards=total,
            next_observations=end,
            following_observations=rollouts.next_observations,
            discounts=weight,
        )
        taken = rollouts.valid.clone()
        taken[horizon:] = False  # what comes after is there for its rewards
        self.ring.add({name: column[taken] for name, column in columns.items()})
