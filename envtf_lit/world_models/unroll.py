"""The one loop that takes a world model step by step: under a policy, or along recorded actions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import Mode, Prediction, WorldModel


@dataclass(frozen=True)
class Step:
    """One step of the rollouts that are still under way.

    Attributes:
        index: steps before this one.
        rows: (R,) which rollouts, as numbered at the start.
        observation: (R, S) acted upon.
        action: (R, A).
        prediction: of the next observation and the reward.
    """

    index: int
    rows: Tensor
    observation: Tensor
    action: Tensor
    prediction: Prediction


def unroll(
    model: WorldModel,
    state: Any,
    act: Callable[[int, Tensor, Tensor], Tensor],
    steps: int,
    *,
    mode: Mode | Callable[[int], Mode] = "mean",
    select: Callable[[int, Tensor], Tensor | None] | None = None,
    observe: Callable[[int, Tensor], Tensor | None] | None = None,
    generator: torch.Generator | None = None,
) -> Iterator[Step]:
    """Yields the rollouts' steps, until `steps` are done or no rollout is left; differentiable where the model is.

    Args:
        model: any world model.
        state: of `model.init`, with B rollouts.
        act: (step index, rows (R,), observations (R, S)) to actions (R, A).
        steps: at most.
        mode: of `WorldModel.step`, or of each step index.
        select: (step index, rows (R,)) to the positions among them that go on, or None for all; asked before a step.
        observe: (step index, rows (R,)) to the observations (R, S) that were really made, or None to go on with the
            model's own; asked before a step.
        generator: of sampled predictions.
    """
    rows = torch.arange(len(model.current(state)), device=model.current(state).device)
    for t in range(steps):
        going_on = None if select is None else select(t, rows)
        if going_on is not None:
            if len(going_on) == 0:
                return
            state, rows = model.gather(state, going_on), rows[going_on]
        seen = None if observe is None else observe(t, rows)
        if seen is not None:
            state = model.observe(state, seen)
        observation = model.current(state)
        action = act(t, rows, observation)
        how = mode(t) if callable(mode) else mode
        state, prediction = model.step(state, action, mode=how, generator=generator)
        yield Step(t, rows, observation, action, prediction)


def lost(prediction: Prediction, novelty_limit: float | None) -> Tensor:
    """(R,) bool, where the model has left what it knows, so far as anyone wants to know.

    Raises:
        UserError: a novelty limit is given and the model has no epistemic variance.
    """
    if novelty_limit is None:
        return torch.zeros_like(prediction.reward, dtype=torch.bool)
    if prediction.novelty is None:
        raise UserError(
            "novelty_limit is set and the world model has no epistemic variance to hold against it: train a "
            "transformer with epistemic: laplace or an ensemble of several members, or set novelty_limit to null."
        )
    return prediction.novelty > novelty_limit
