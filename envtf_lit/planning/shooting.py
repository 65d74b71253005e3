"""Planners that draw candidates and keep the good ones: random shooting, CEM, iCEM and MPPI."""

from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.planning.noise import coloured_noise
from envtf_lit.planning.options import CEMOptions, ICEMOptions, MPPIOptions, PlannerOptions, RandomShootingOptions
from envtf_lit.planning.planner import Own, Planner, Search, best, chosen

SMALLEST_STD = 1e-3  # of CEM's Gaussians, in units of half the action range


class RandomShooting(Planner[RandomShootingOptions]):
    """The best of uniform candidates and of the plans that the search began at."""

    Options: ClassVar[type[PlannerOptions]] = RandomShootingOptions

    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        B, _, H, A = starts.shape
        drawn = 2 * torch.rand(self.options.samples, H, A, generator=generator, device=starts.device) - 1
        plans = torch.cat([starts, drawn.expand(B, -1, -1, -1)], 1)
        returns = self.judge(plans, generator)
        taken = best(plans, returns)
        return Search(taken, torch.zeros_like(taken), plans, returns, returns.argmax(1, keepdim=True))


class GaussianPlanner(Planner[Own]):
    """What draws candidates from a Gaussian about a plan."""

    def around(
        self, mean: Tensor, std: Tensor | float, count: int, colour: float, generator: torch.Generator
    ) -> Tensor:
        """(B, N, H, A) candidates about (B, H, A), kept in the range; each row's are made from the same noise."""
        H, A = mean.shape[1:]
        noise = coloured_noise(count, H, A, colour=colour, generator=generator, device=mean.device)
        width = std[:, None] if isinstance(std, Tensor) else std
        return (mean[:, None] + width * noise).clamp(-1, 1)


class CEM(GaussianPlanner[CEMOptions]):
    """The cross-entropy method: a Gaussian over plans, fitted again and again to the best of its draws."""

    Options: ClassVar[type[PlannerOptions]] = CEMOptions

    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        o = self.options
        mean = self.best_start(starts, generator)
        std, plans, returns, elites = torch.full_like(mean, o.std), starts, starts, starts
        for _ in range(o.iterations):
            plans = torch.cat([starts, self.around(mean, std, o.samples, 0.0, generator)], 1)
            returns = self.judge(plans, generator)
            elites = returns.topk(o.elites, 1).indices
            mean, std = refit(mean, std, chosen(plans, elites), o.momentum)
        return Search(mean, std, plans, returns, elites)


class ICEM(GaussianPlanner[ICEMOptions]):
    """CEM with coloured noise, shrinking rounds and kept elites; it takes the best candidate, not the mean."""

    Options: ClassVar[type[PlannerOptions]] = ICEMOptions

    def reset(self) -> None:
        """See `Planner.reset`."""
        super().reset()
        self._kept: Tensor | None = None  # (B, K, H, A) good plans of the search before

    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        o = self.options
        mean, kept, number = self.best_start(starts, generator), max(1, round(o.kept * o.elites)), o.samples
        std, pool, plans, returns, elites = torch.full_like(mean, o.std), starts, starts, starts, starts
        if self._kept is not None and o.warm_start:
            pool = torch.cat([starts, shifted(self._kept)], 1)
        for round_ in range(o.iterations):
            plans = torch.cat([pool, self.around(mean, std, number, o.colour, generator)], 1)
            if round_ == o.iterations - 1:
                plans = torch.cat([plans, mean[:, None]], 1)
            returns = self.judge(plans, generator)
            elites = returns.topk(o.elites, 1).indices
            mean, std = refit(mean, std, chosen(plans, elites), o.momentum)
            pool = torch.cat([starts, chosen(plans, elites[:, :kept])], 1)
            number = max(2 * o.elites, int(number / o.decay))
        return Search(best(plans, returns), std, plans, returns, elites)

    def _remember(self, found: Search) -> None:
        kept = max(1, round(self.options.kept * self.options.elites))
        self._kept = chosen(found.candidates, found.elites[:, :kept])


class MPPI(GaussianPlanner[MPPIOptions]):
    """Path integral control: the mean of noisy copies of the plan, each weighted by `exp(J / temperature)`.

    The cost that Williams et al. put on leaving the uncontrolled system is left out (their gamma is 0, as in TD-MPC2).
    """

    Options: ClassVar[type[PlannerOptions]] = MPPIOptions

    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        o = self.options
        mean, std, plans, returns = self.best_start(starts, generator), starts, starts, starts
        for _ in range(o.iterations):
            plans = torch.cat([mean[:, None], self.around(mean, o.std, o.samples, o.colour, generator)], 1)
            returns = self.judge(plans, generator)
            weight = (returns / o.temperature).softmax(1)[..., None, None]  # (B, N, 1, 1)
            mean = (weight * plans).sum(1)
            std = (weight * (plans - mean[:, None]).square()).sum(1).sqrt()
        elites = returns.topk(max(1, o.samples // 10), 1).indices
        return Search(mean, std, plans, returns, elites)


def shifted(plans: Tensor) -> Tensor:
    """Plans (..., H, A) one step later; at their end the middle of the action range."""
    return torch.cat([plans[..., 1:, :], torch.zeros_like(plans[..., :1, :])], -2)


def refit(mean: Tensor, std: Tensor, elites: Tensor, momentum: float) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (B, H, A) drawn towards those of the elites (B, K, H, A)."""
    spread, centre = torch.var_mean(elites, 1, correction=0)
    width = momentum * std + (1 - momentum) * spread.sqrt()
    return momentum * mean + (1 - momentum) * centre, width.clamp(min=SMALLEST_STD)
