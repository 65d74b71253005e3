"""Conservative Q-Learning (Kumar et al. 2020), on data alone or on data and imagination."""

import math

import torch
from torch import Tensor

from envtf_lit.agents.base import OfflineAgent

Batch = dict[str, Tensor]


class CQL(OfflineAgent):
    """SAC-based CQL(H): critics, their targets, a squashed Gaussian actor and an automatic entropy temperature."""

    def critic_loss(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """`1/2 Bellman + weight * conservative` (paper, equation 5), summed over critics."""
        with torch.no_grad():
            target = self.td_target(batch, generator)
            actions, log_density = self.proposals(batch, generator)
        q = self.critics(batch["observations"], torch.cat([batch["actions"].unsqueeze(1), actions], dim=1))
        q_data, q_proposed = q[..., 0], q[..., 1:]  # (n, B), (n, B, 3N)
        bellman = 0.5 * (q_data - target).square().mean(1).sum()
        gap = self.conservative_gap(q_data, q_proposed, log_density, batch["real"])
        loss = bellman + self.options.cql_weight * gap.sum()
        logs = dict(bellman_loss=bellman, conservative_gap=gap.mean(), q_data=q_data.mean(), q_target=target.mean())
        return loss, logs

    def td_target(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """`r + gamma (1 - terminated) min_i Q_i'(s', a'), a' ~ pi(s')`: no entropy term, bootstraps truncations.

        With n-step transitions r is their discounted sum, gamma the discount of all n, s' where they end.
        """
        action, _ = self.actor.sample(batch["next_observations"], generator=generator)
        following = self.target_critics(batch["next_observations"], action).min(0).values
        return batch["rewards"] + batch["discounts"] * following

    def proposals(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Actions (B, 3N, A) for the log-sum-exp, uniform, from pi(s) and from pi(s'), with log-density (B, 3N)."""
        B, A, N = len(batch["rewards"]), self.actor.action_low.shape[0], self.options.sampled_actions
        low, high = self.actor.action_low, self.actor.action_high
        uniform = low + (high - low) * torch.rand(B, N, A, generator=generator, device=low.device)
        now, now_density = self.actor.sample(batch["observations"], N, generator=generator)
        later, later_density = self.actor.sample(batch["next_observations"], N, generator=generator)
        uniform_density = torch.full((B, N), -A * math.log(2.0), device=low.device)  # on the squashed range [-1, 1]
        return torch.cat([uniform, now, later], 1), torch.cat([uniform_density, now_density, later_density], 1)

    def conservative_gap(self, q_data: Tensor, q_proposed: Tensor, log_density: Tensor, real: Tensor) -> Tensor:
        """(n,) `T log mean exp((Q(s, a_j) - T log p_j) / T) - Q(s, a)`: what CQL pushes down, minus what it pushes up.

        The first term runs over all rows, the second over real rows alone (COMBO, Yu et al. 2021) or over all rows
        (equation 5 read literally), as `penalty_up_on` says.
        """
        T = self.options.temperature
        pushed_down = T * (torch.logsumexp(q_proposed / T - log_density, dim=-1) - math.log(q_proposed.shape[-1]))
        imagination = self.options.imagination
        if imagination is not None and imagination.penalty_up_on == "real":
            return pushed_down.mean(1) - (q_data * real).sum(1) / real.sum()
        return (pushed_down - q_data).mean(1)

    def actor_loss(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """`E[alpha log pi(a|s) - min_i Q_i(s, a)], a ~ pi(s)`, alpha held fixed, and `clone_weight * clone_loss`."""
        action, log_density = self.actor.sample(batch["observations"], generator=generator)
        q = self.critics(batch["observations"], action).min(0).values
        loss = (self.log_alpha.detach().exp() * log_density - q).mean()
        logs = dict(q_policy=q.mean(), entropy=-log_density.mean())
        if self.options.clone_weight > 0:
            logs["clone_loss"] = self.clone_loss(batch)
            loss = loss + self.options.clone_weight * logs["clone_loss"]
        return loss, logs

    def temperature_loss(self, entropy: Tensor) -> Tensor:
        """`alpha (H - H_target)`, H_target = -A (Haarnoja et al. 2018, equation 18)."""
        return self.log_alpha.exp() * (entropy.detach() + self.actor.action_low.shape[0])
