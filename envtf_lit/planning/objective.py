"""What a plan is worth: the one measure by which all planners judge."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from envtf_lit.planning.options import PlannerOptions
from envtf_lit.policy import Policy
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.unroll import lost, unroll

Rule = Callable[[Tensor], Tensor]  # next observations (R, S) to bool (R,)
Value = Callable[[Tensor], Tensor]  # observations (R, S) to what is still to come (R,)
Reward = Callable[[Tensor, Tensor, Tensor], Tensor]  # observations, actions, next observations to rewards (R,)
ROWS = 4_096  # candidates imagined at a time: what their caches take is bounded by it


@dataclass(frozen=True)
class Objective:
    """The discounted return of a plan that a world model imagines, less what its uncertainty costs.

        J = sum_t discount^t (r_t - penalty u_t) + discount^H V(s_H)

    H is the horizon and the tail, in which the prior acts. Nothing follows a fall. A candidate for which the model
    has left what it knows is given up: each step that it lacks counts as the worst step, and its end as the worst
    end, of all candidates beside it.

    Attributes:
        model: any world model.
        options: of the planner.
        terminated: the robot's rule.
        reward: takes the place of the model's own; in the data's units.
        value: of the last state; None: nothing follows.
        prior: acts in the tail.
    """

    model: WorldModel
    options: PlannerOptions
    terminated: Rule = never_terminated
    reward: Reward | None = None
    value: Value | None = None
    prior: Policy | None = None

    def returns(self, state: Any, plans: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """J (B, N) of N plans (B, N, H, A), in the environment's action range, from each of B rows of a state.

        The state stays valid: candidates run in copies of its rows. Differentiable where the model is. A return that is
        not finite comes out as minus infinity.
        """
        B, N = plans.shape[:2]
        parts = []
        for rows in torch.arange(B, device=plans.device).split(max(1, ROWS // N)):
            forked = self.model.gather(state, rows.repeat_interleave(N))
            columns = self._imagine(forked, plans[rows].flatten(0, 1), generator)
            parts.append(self._total(*(column.unflatten(0, (len(rows), N)) for column in columns)))
        total = torch.cat(parts)
        return torch.where(total.isfinite(), total, -torch.inf)

    def _imagine(
        self, state: Any, plans: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rewards (R, H + tail), which steps count and which are lost (R, H) bool, and the value (R,) of the end."""
        o, end, table = self.options, plans[:, 0], []
        going = torch.ones(len(plans), dtype=torch.bool, device=plans.device)
        gone = torch.zeros_like(going)

        def act(t: int, rows: Tensor, seen: Tensor) -> Tensor:
            return plans[:, t] if t < o.horizon or self.prior is None else self.prior.act(seen)

        for step in unroll(self.model, state, act, o.horizon + o.tail, mode=o.mode, generator=generator):
            p = step.prediction
            reward = p.reward if self.reward is None else self.reward(step.observation, step.action, p.observation)
            gone = gone | (going & lost(p, o.novelty_limit))
            going = going & ~gone
            table.append((reward - o.penalty * p.uncertainty, going, gone))
            going, end = going & ~self.terminated(p.observation), p.observation
        rewards, counted, missing = (torch.stack(column, 1) for column in zip(*table, strict=True))
        value = torch.zeros_like(rewards[:, 0]) if self.value is None else self.value(end)
        return rewards, counted, missing, torch.where(going, value, 0.0)

    def _total(self, rewards: Tensor, counted: Tensor, missing: Tensor, value: Tensor) -> Tensor:
        """J (B, N) of columns (B, N, H) and ends' values (B, N)."""
        worst = _least(rewards, counted)[..., None]
        steps = torch.where(counted, rewards, torch.where(missing, worst, 0.0))
        weight = self.options.discount ** torch.arange(rewards.shape[-1] + 1, device=rewards.device)
        end = torch.where(missing[..., -1], _least(value, ~missing[..., -1]), value)
        return (steps * weight[:-1]).sum(-1) + weight[-1] * end


def _least(values: Tensor, known: Tensor) -> Tensor:
    """(B, 1) the least finite known value (B, N, …) of each row; 0 where none is known."""
    kept = torch.where(known & values.isfinite(), values, torch.inf).flatten(1).amin(1, keepdim=True)
    return torch.where(kept.isfinite(), kept, 0.0).detach()


@torch.no_grad()
def imagined_paths(model: WorldModel, state: Any, plans: Tensor) -> Tensor:
    """Observations (B, N, H + 1, S) on the way along plans (B, N, H, A), by mean predictions; `state` stays valid."""
    B, N, H = plans.shape[:3]
    rows = torch.arange(B, device=plans.device).repeat_interleave(N)
    flat, forked = plans.flatten(0, 1), model.gather(state, rows)
    seen = [model.current(forked)]
    seen += [step.prediction.observation for step in unroll(model, forked, lambda t, rows, seen: flat[:, t], H)]
    return torch.stack(seen, 1).unflatten(0, (B, N))
