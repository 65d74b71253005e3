"""Planning by gradient ascent: the plan's return is differentiated through the model."""

from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.planning.options import GradientOptions, PlannerOptions
from envtf_lit.planning.planner import Planner, Search, best


class GradientPlanner(Planner[GradientOptions]):
    """Adam on several plans side by side, each kept in the action range; the best that any was at any time is taken."""

    Options: ClassVar[type[PlannerOptions]] = GradientOptions

    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        o, (B, K, H, A) = self.options, starts.shape
        further = max(0, o.samples - K)
        noise = torch.randn(further, H, A, generator=generator, device=starts.device)
        begin = torch.cat([starts, (self.best_start(starts, generator)[:, None] + o.std * noise).clamp(-1, 1)], 1)
        plans = begin.clone().requires_grad_()
        adam = torch.optim.Adam([plans], lr=o.learning_rate)
        found, reached = begin, torch.full((B, begin.shape[1]), -torch.inf, device=starts.device)
        for _ in range(o.iterations):
            with torch.enable_grad():
                returns = self.judge(plans, generator)
                (slope,) = torch.autograd.grad(
                    returns.sum(), plans
                )  # not backward: the model's weights stay as they are
            found, reached = _better(found, reached, plans.detach(), returns.detach())
            plans.grad = -slope.nan_to_num(0.0, 0.0, 0.0)
            adam.step()
            plans.clamp_(-1, 1)
        found, reached = _better(found, reached, plans.detach(), self.judge(plans.detach(), generator))
        taken = best(found, reached)
        return Search(taken, torch.zeros_like(taken), found, reached, reached.argmax(1, keepdim=True))


def _better(plans: Tensor, returns: Tensor, others: Tensor, theirs: Tensor) -> tuple[Tensor, Tensor]:
    """The better one of each pair of plans (B, N, H, A), and its return (B, N)."""
    better = theirs > returns
    return torch.where(better[..., None, None], others, plans), torch.where(better, theirs, returns)
