"""What all planners are: policies that remember, and search anew at every step."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Generic, TypeVar, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from envtf_lit.actors import in_kind
from envtf_lit.errors import UserError
from envtf_lit.options.schema import build
from envtf_lit.planning.objective import Objective, Reward, Rule, Value
from envtf_lit.planning.options import PlannerOptions
from envtf_lit.policy import Policy
from envtf_lit.robots.termination import never_terminated
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.unroll import unroll

ROUNDING = 0.02  # of a reward that is always the same, within which a trained model predicts it

Own = TypeVar("Own", bound=PlannerOptions)


@dataclass(frozen=True)
class Search:
    """The result of a search from B states, in units of half the action range about its middle.

    Attributes:
        taken: (B, H, A) the plan whose first action is the one to take.
        std: (B, H, A) how far the good plans lie about it; 0 where the family has no such notion.
        candidates: (B, N, H, A) the last round's.
        returns: (B, N) what they are worth.
        elites: (B, K) the best of them, best first: those that the plan was made from.
    """

    taken: Tensor
    std: Tensor
    candidates: Tensor
    returns: Tensor
    elites: Tensor


class Planner(ABC, Generic[Own]):
    """A policy that plans: at every step it searches for the best actions of the next ones, and takes the first.

    It follows its episodes through the model, whose state it keeps: each action that `act` returns is taken to be done,
    and each observation given to be what came of it. So the model sees the whole episode, and `reset` must be called
    where another one begins. Random numbers are shared by all rows, so that a row's plan does not depend on those
    beside it.

    Args:
        model: any world model, in eval mode, on the observations' device.
        action_low, action_high: (A,) the action range.
        options: of the family; None takes its defaults.
        terminated: the robot's rule.
        reward: takes the place of the model's own.
        value: of the state after the plan; None: nothing follows.
        prior: a policy without memory. The search begins at its plan wherever that is better than what is left of the
            plan before, and never ends at a worse one.
        seed: of everything random, from `reset` on.

    Raises:
        UserError: an option out of range, a tail without a prior, or an action range of another size than the model's
            actions.
    """

    Options: ClassVar[type[PlannerOptions]]
    options: Own

    def __init__(
        self,
        model: WorldModel,
        action_low: Tensor | Sequence[float],
        action_high: Tensor | Sequence[float],
        options: Own | None = None,
        *,
        terminated: Rule = never_terminated,
        reward: Reward | None = None,
        value: Value | None = None,
        prior: Policy | None = None,
        seed: int = 0,
    ) -> None:
        self.options = build(self.Options, asdict(options or self.Options()), "")  # pyright: ignore[reportAttributeAccessIssue]
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (action_low, action_high))
        if low.shape != (model.action_dim,) or high.shape != (model.action_dim,):
            raise UserError(
                f"The action range has {low.numel()} low and {high.numel()} high limits, and the world model takes "
                f"actions of size {model.action_dim}: give it one of each for every dimension."
            )
        if not ((low < high) & low.isfinite() & high.isfinite()).all():
            raise UserError(
                f"The action range is {low.tolist()} to {high.tolist()}: a planner searches a finite range, so give "
                "finite limits, each low one less than its high one."
            )
        if self.options.tail > 0 and prior is None:
            raise UserError(
                f"tail is {self.options.tail}, in which the prior acts, and there is none: give one, or set it to 0."
            )
        self.model, self.prior, self.seed = model, prior, seed
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)
        self.objective = Objective(model, self.options, terminated, reward, value, prior)
        self.generators: dict[torch.device, torch.Generator] = {}
        self.reset()

    def reset(self) -> None:
        """Forgets the episodes it was in; the next ones come out as after a reset before."""
        self._state: Any = None
        self._rows = 0
        self._left: Tensor | None = None  # (B, H, A) what the plan before has left
        self.generators.clear()

    @overload
    def act(
        self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> Tensor: ...

    @overload
    def act(
        self, observation: ArrayLike, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> np.ndarray: ...

    @torch.no_grad()
    def act(
        self, observation: Tensor | ArrayLike, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> Tensor | np.ndarray:
        """Observations (B, S), the next ones of B episodes, to the first actions (B, A) of new plans.

        One observation (S,) gives one action (A,), and arrays and lists give arrays, as in `Actor.act`.

        Args:
            observation: of as many episodes as since the last `reset`.
            deterministic: False adds noise as wide as the good plans lie about the one taken, if the family knows.
            generator: of the candidates; None takes the planner's own, which begins anew at `reset`.

        Raises:
            UserError: another number or size of observations, a state that no candidate leaves with a finite return, a
                novelty limit where the model has no epistemic variance, or nothing to choose plans by.
        """

        def first(rows: Tensor) -> Tensor:
            return self._first(rows, deterministic, generator) if rows.dim() != 1 else first(rows[None])[0]

        return in_kind(first, observation, self.middle.device)

    def _first(self, observation: Tensor, deterministic: bool, generator: torch.Generator | None) -> Tensor:
        """See `act`."""
        generator = self._own_generator(observation.device) if generator is None else generator
        found = self.search(observation, generator)
        self._left = torch.cat([found.taken[:, 1:], torch.zeros_like(found.taken[:, :1])], 1)
        action = found.taken[:, 0]
        if not deterministic:
            noise = torch.randn(action.shape, generator=generator, device=action.device)
            action = (action + found.std[:, 0] * noise).clamp(-1, 1)
        action = self.scaled(action)
        self._remember(found)
        self._state, _ = self.model.step(self._state, action)
        return action

    @torch.no_grad()
    def search(self, observation: Tensor, generator: torch.Generator | None = None) -> Search:
        """The search of `act`, its candidates and all; afterwards the model's state is at this observation."""
        generator = self._own_generator(observation.device) if generator is None else generator
        self._follow(observation)
        found = self._search(self._starts(len(observation)), generator)
        if not found.returns.isfinite().any(1).all():
            row = int((~found.returns.isfinite().any(1)).nonzero()[0, 0])
            raise UserError(
                f"No plan from observation {row} has a finite return, so there is nothing to choose by: the world "
                "model's predictions, or the reward or value given, are not finite there; train the model with "
                "bounded: true, plan fewer steps, or give a reward if the model has none."
            )
        self._check_reward(found.returns)
        return found

    def _check_reward(self, returns: Tensor) -> None:
        """Refuses to choose by returns (B, N) that are all what a log of equal rewards taught the model to predict."""
        judge, o = self.objective, self.options
        constant = getattr(getattr(self.model, "normaliser", None), "constant_reward", None)
        lives = constant != 0 and judge.terminated is not never_terminated  # it is paid for as long as it stands
        if constant is None or lives or judge.reward is not None or judge.value is not None:
            return
        steps = sum(o.discount**t for t in range(o.horizon + o.tail))
        if ((returns - constant * steps).abs() <= ROUNDING * (abs(constant) or 1.0) * steps).all():
            raise UserError(
                f"The world model's log pays {constant:g} at every step, so that no plan is better than another: give "
                "the planner a reward or a value, or train the model on a log that has rewards."
            )

    @property
    def state(self) -> Any:
        """The model's state at the last observation that was searched from; the next `act` consumes it."""
        return self._state

    def scaled(self, plan: Tensor) -> Tensor:
        """Plans (..., A) in units of half the action range about its middle, as actions."""
        return self.middle.to(plan.device) + plan * self.half.to(plan.device)

    def _own_generator(self, device: torch.device) -> torch.Generator:
        if device not in self.generators:
            self.generators[device] = torch.Generator(device).manual_seed(self.seed)
        return self.generators[device]

    def _follow(self, observation: Tensor) -> None:
        """Brings the model's state to what was really seen."""
        if observation.dim() != 2 or observation.shape[1] != self.model.observation_dim:
            raise UserError(
                f"The world model is of observations of size {self.model.observation_dim}, and the planner was given "
                f"some of shape {tuple(observation.shape)}: plan with a model of this environment."
            )
        B = len(observation)
        if self._state is not None and B != self._rows:
            raise UserError(
                f"The planner follows {self._rows} episodes and was given {B} observations: reset() it before others."
            )
        if self._state is None:
            lengths = torch.ones(B, dtype=torch.long, device=observation.device)
            none = observation.new_zeros(B, 0, self.model.action_dim)
            self._state, self._rows = self.model.init(observation[:, None], none, lengths), B
        else:
            self._state = self.model.observe(self._state, observation)

    def _starts(self, rows: int) -> Tensor:
        """(B, K, H, A) plans that a search may begin at: what was left, and the prior's; else idleness."""
        device = self.model.current(self._state).device
        size = rows, self.options.horizon, self.model.action_dim
        left = self._left if self.options.warm_start else None
        idle = [torch.zeros(size, device=device)] if self.prior is None else []
        plans = idle if left is None else [left]
        if (prior := self.prior) is not None:
            alone = self.model.gather(self._state, torch.arange(rows, device=device))
            act = lambda t, row, seen: prior.act(seen, deterministic=True)  # noqa: E731
            steps = unroll(self.model, alone, act, self.options.horizon)
            actions = torch.stack([step.action for step in steps], 1)
            plans.append(((actions - self.middle.to(device)) / self.half.to(device)).clamp(-1, 1))
        return torch.stack(plans, 1)

    def judge(self, plans: Tensor, generator: torch.Generator | None) -> Tensor:
        """Returns (B, N) of plans (B, N, H, A) in units of half the action range."""
        return self.objective.returns(self._state, self.scaled(plans), generator)

    def best_start(self, starts: Tensor, generator: torch.Generator | None) -> Tensor:
        """(B, H, A) the best of the plans that a search may begin at (B, K, H, A)."""
        if starts.shape[1] == 1:
            return starts[:, 0]
        return best(starts, self.judge(starts, generator))

    @abstractmethod
    def _search(self, starts: Tensor, generator: torch.Generator) -> Search:
        """Searches from the model's present state; `starts` are as of `_starts`."""

    def _remember(self, found: Search) -> None:  # most keep nothing but the plan
        """Keeps what the next search begins with."""


def best(plans: Tensor, returns: Tensor) -> Tensor:
    """(B, H, A) those of the greatest return (B, N) among plans (B, N, H, A)."""
    return plans[torch.arange(len(plans), device=plans.device), returns.argmax(1)]


def chosen(plans: Tensor, index: Tensor) -> Tensor:
    """(B, K, H, A) the plans of these indices (B, K)."""
    return plans[torch.arange(len(plans), device=plans.device)[:, None], index]
