"""Dynamic programming through a world model: value iteration on a grid of states, for systems of few dimensions."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.options.numbers import Count, NonzeroShare, Positive
from envtf_lit.planning.objective import Reward, Rule
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.interface import WorldModel


@dataclass(frozen=True)
class Axis:
    """One coordinate of a grid.

    Attributes:
        low, high: its range.
        count: points on it.
        circular: `high` is `low` again, as of an angle.
    """

    low: float
    high: float
    count: int
    circular: bool = False

    @property
    def points(self) -> Tensor:
        """(count,) evenly spaced; of a circular axis without `high`."""
        return torch.linspace(self.low, self.high, self.count + self.circular)[: self.count]

    def place(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points before and after values (R,), and how far (in [0, 1]) each lies between them; ends hold beyond."""
        step = (self.high - self.low) / (self.count - 1 + self.circular)
        at = (value - self.low) / step
        at = at % self.count if self.circular else at.clamp(0, self.count - 1)
        below = at.floor().clamp(max=self.count - 1)
        above = (below + 1) % self.count if self.circular else (below + 1).clamp(max=self.count - 1)
        return below.long(), above.long(), at - below


@dataclass(frozen=True)
class Chart:
    """A grid over a system's states, and how its coordinates are observed.

    Attributes:
        axes: of the D coordinates.
        observed: coordinates (..., D) to observations (..., S).
        coordinates: the inverse.
    """

    axes: tuple[Axis, ...]
    observed: Callable[[Tensor], Tensor]
    coordinates: Callable[[Tensor], Tensor]

    @property
    def points(self) -> Tensor:
        """(G, D) all of the grid, the last axis fastest."""
        return torch.cartesian_prod(*(axis.points for axis in self.axes)).view(-1, len(self.axes))

    def interpolation(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The 2^D points (R, 2^D) around observations (R, S), and their multilinear weights."""
        value = self.coordinates(observation)
        places = [axis.place(value[:, d]) for d, axis in enumerate(self.axes)]
        indices, weights = [], []
        for corner in itertools.product((0, 1), repeat=len(self.axes)):
            index, weight = torch.zeros_like(places[0][0]), torch.ones_like(places[0][2])
            for side, axis, (below, above, share) in zip(corner, self.axes, places, strict=True):
                index = index * axis.count + (above if side else below)
                weight = weight * (share if side else 1 - share)
            indices.append(index)
            weights.append(weight)
        return torch.stack(indices, 1), torch.stack(weights, 1)


@dataclass(frozen=True)
class ValueIterationOptions:
    """The grid's actions, and when the iteration ends.

    Attributes:
        actions: evenly spaced in each dimension of the action range, its ends among them.
        discount: of future rewards, per step.
        tolerance: largest change of any value in a sweep, at which the iteration has converged.
        sweeps: at most.
    """

    actions: Count = 15
    discount: NonzeroShare = 0.99
    tolerance: Positive = 0.001
    sweeps: Count = 2_000


class ValueIteration:
    """A policy that is greedy in the values of a gridded world model: `V(s) = max_a r(s, a) + discount V(s')`.

    The model is asked once about every point and action, each without history; V is interpolated between the points.

    Args:
        model: any world model whose state the chart's coordinates say all of.
        chart: the grid.
        action_low, action_high: (A,) the action range.
        options: of actions and convergence.
        terminated: next observations to whether nothing follows.
        reward: takes the place of the model's own.

    Attributes:
        values: (G,) of the grid's points.
        sweeps: that were needed.

    Raises:
        UserError: a chart of another size than the model's observations, an axis or a choice of actions of fewer than
            two points, predictions that are not finite, or values that have not converged.
    """

    def __init__(
        self,
        model: WorldModel,
        chart: Chart,
        action_low: Tensor | Sequence[float],
        action_high: Tensor | Sequence[float],
        options: ValueIterationOptions | None = None,
        *,
        terminated: Rule = never_terminated,
        reward: Reward | None = None,
    ) -> None:
        self.chart, self.options = chart, options or ValueIterationOptions()
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (action_low, action_high))
        if min(self.options.actions, *(axis.count for axis in chart.axes)) < 2:
            raise UserError(
                "Value iteration needs two actions or more, and two points or more on each axis: give more."
            )
        each = [torch.linspace(float(a), float(b), self.options.actions) for a, b in zip(low, high, strict=True)]
        self.actions = torch.cartesian_prod(*each).view(-1, len(low))  # (K, A)
        observation = chart.observed(chart.points)
        if observation.shape[1] != model.observation_dim or len(low) != model.action_dim:
            raise UserError(
                f"The chart is of observations of size {observation.shape[1]} and actions of size {len(low)}, and the "
                f"world model of {model.observation_dim} and {model.action_dim}: take a model of this system."
            )
        self._tabulate(model, observation, terminated, reward)
        self.values, self.sweeps = self._iterate()

    @torch.no_grad()
    def _tabulate(self, model: WorldModel, points: Tensor, terminated: Rule, reward: Reward | None) -> None:
        """What the model says of each point and action: rewards (K, G), and where they lead, interpolated."""
        lengths = torch.ones(len(points), dtype=torch.long)
        begin = model.init(points[:, None], points.new_zeros(len(points), 0, self.actions.shape[1]), lengths)
        rows, table = torch.arange(len(points)), []
        for action in self.actions:
            _, p = model.step(model.gather(begin, rows), action.expand(len(points), -1))
            paid = p.reward if reward is None else reward(points, action.expand(len(points), -1), p.observation)
            if not (paid.isfinite().all() and p.observation.isfinite().all()):
                raise UserError(
                    "The world model's predictions are not finite on the whole grid: train it with bounded."
                )
            index, weight = self.chart.interpolation(p.observation)
            table.append((paid, index, weight * (~terminated(p.observation)).float()[:, None]))
        self._rewards, self._index, self._weight = (torch.stack(columns) for columns in zip(*table, strict=True))

    def _gains(self, values: Tensor) -> Tensor:
        """(K, G) the value of each action at each point."""
        following = (values[self._index] * self._weight).sum(-1)
        return self._rewards + self.options.discount * following

    def _iterate(self) -> tuple[Tensor, int]:
        values = torch.zeros(self._rewards.shape[1])
        for sweep in range(1, self.options.sweeps + 1):
            improved = self._gains(values).amax(0)
            change = float((improved - values).abs().max())
            values = improved
            if change <= self.options.tolerance:
                return values, sweep
        raise UserError(
            f"The values still change by {change:.3g} after {self.options.sweeps} sweeps: raise sweeps or tolerance, "
            "or lower discount."
        )

    def value(self, observation: Tensor) -> Tensor:
        """Observations (R, S) to their interpolated values (R,), which end other planners' plans as well."""
        index, weight = self.chart.interpolation(observation)
        return (self.values[index] * weight).sum(-1)

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to the mean (B, A) of the best actions at the points around; nothing is random in it."""
        index, weight = self.chart.interpolation(observation)
        best = self.actions[self._gains(self.values).argmax(0)]  # (G, A)
        return (best[index] * weight[..., None]).sum(1)
