"""Conservative Q-Learning (Kumar et al. 2020), CQL(H) on soft actor-critic: Q of actions that the log lacks is low."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs
from envtf_lit.agents.sac import SAC, SACOptions
from envtf_lit.options.numbers import Count, NonNegative, Positive
from envtf_lit.options.schema import rare


@dataclass(frozen=True)
class ConservativeOptions(PolicyOptions):
    """Options of the conservative term.

    Attributes:
        cql_weight: weight of the conservative term, beside half of the squared error (the paper's; public code has the
            whole, so that a weight of theirs is half as much here). In units of Q as the critics learn it, which
            `normalise_returns` divides by the return scale (the spread of the log's returns): a weight of w on plain
            rewards is w / scale.
        cql_temperature: of the log-sum-exp, in the same units, so that 1 is one spread of the log's returns: actions
            that differ by far less count alike, and the term pushes their mean down. Published is 1 in plain rewards:
            1 / scale here, with which little but the best of the proposals counts.
        sampled_actions: actions of each kind (uniform, pi(s), pi(s')) in the log-sum-exp.
    """

    cql_weight: NonNegative = 0.1
    cql_temperature: Positive = rare(1.0)
    sampled_actions: Count = rare(2)


@dataclass(frozen=True)
class CQLOptions(ConservativeOptions, SACOptions):
    """Conservative Q-Learning has the options of its term, and soft actor-critic's.

    Attributes:
        clone_weight: weight in the actor's objective of cloning the real rows' actions, which keeps it near the log; of
            the mean over action dimensions. Ours: published is 0.
    """

    clone_weight: NonNegative = 0.75


class CQL(SAC):
    """Conservative Q-Learning on data alone."""

    Options: ClassVar[type[PolicyOptions]] = CQLOptions
    label = "CQL"
    cures: ClassVar[Mapping[str, str]] = {"": "raise cql_weight, or lower critic_learning_rate"}
    options: CQLOptions

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Logs]:
        """`1/2 Bellman + weight * conservative` (equation 4; the paper's equation 5), summed over critics."""
        with torch.no_grad():
            target = self.td_target(batch)
            actions, log_density = self.proposals(batch)
        q = self.critics(batch["observations"], torch.cat([batch["actions"].unsqueeze(1), actions], dim=1))
        q_data, q_proposed = q[..., 0], q[..., 1:]  # (n, B), (n, B, 3N)
        bellman = 0.5 * (q_data - target).square().mean(1).sum()
        gap = self.conservative_gap(q_data, q_proposed, log_density, batch["real"])
        loss = bellman + self.options.cql_weight * gap.sum()
        logs = dict(bellman_loss=bellman, conservative_gap=gap.mean(), q_data=q_data.mean(), q_target=target.mean())
        return loss, logs

    def td_target(self, batch: Batch) -> Tensor:
        """`r + gamma (1 - terminated) min_i Q_i'(s', a'), a' ~ pi(s')`: without entropy; bootstraps truncations.

        With n-step transitions r is their discounted sum, gamma the discount of all n, s' where they end.
        """
        action, _ = self.actor.sample(batch["next_observations"], generator=self.generator)
        following = self.target_critics(batch["next_observations"], action).min(0).values
        return batch["rewards"] + batch["discounts"] * following

    def proposals(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Actions (B, 3N, A) for the log-sum-exp, uniform, from pi(s) and from pi(s'), with log-density (B, 3N).

        s' is the state one step later, whose actions are plausible in s, too; not where n-step transitions end.
        """
        B, A, N = len(batch["rewards"]), self.action_dim, self.options.sampled_actions
        low, high = self.actor.action_low, self.actor.action_high
        uniform = low + (high - low) * torch.rand(B, N, A, generator=self.generator, device=low.device)
        states = torch.stack([batch["observations"], batch["following_observations"]], 1).flatten(0, 1)
        drawn, density = self.actor.sample(states, N, generator=self.generator)  # (2B, N, A): now, later, now, …
        uniform_density = torch.full((B, N), -A * math.log(2.0), device=low.device)  # on the squashed range [-1, 1]
        actions = torch.cat([uniform, drawn.reshape(B, 2 * N, A)], 1)
        return actions, torch.cat([uniform_density, density.reshape(B, 2 * N)], 1)

    def pushed_down(self, q_proposed: Tensor, log_density: Tensor) -> Tensor:
        """(n, B) `T log mean exp(Q(s, a_j) / T - log p_j)`: the soft maximum of Q, `T log integral exp(Q(s, a) / T) da`
        over the squashed range, by importance sampling."""
        T = self.options.cql_temperature
        return T * (torch.logsumexp(q_proposed / T - log_density, dim=-1) - math.log(q_proposed.shape[-1]))

    def conservative_gap(self, q_data: Tensor, q_proposed: Tensor, log_density: Tensor, real: Tensor) -> Tensor:
        """(n,) what CQL pushes down less what it pushes up, both over all rows: on a mixture, equation 5 as written."""
        return (self.pushed_down(q_proposed, log_density) - q_data).mean(1)
