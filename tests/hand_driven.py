"""Agents that a test updates by hand, without a trainer; batches and rollouts to learn from, and a linear world."""

from typing import Any

import torch
from torch import Tensor

from envtf_lit.agents.phases import Batch
from envtf_lit.agents.value_gradient import ValueGradientOptions
from envtf_lit.data.loaders import DrawnRows, Transitions
from envtf_lit.imagination.buffer import Imagination, ImaginedBatches
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.imagination.rollouts import Rollouts
from tests.analytic import linear_data, linear_world

S, A, B = 3, 1, 8
EPISODES = (30, 40)
SHORT = ValueGradientOptions(updates=3, rollouts=4, horizon=4)


def hand_driven(cls: type[Any], *, source: ImaginedBatches | None = None, action_dim: int = A, **options: Any) -> Any:
    """An agent of 60 updates in epochs of ten, without a warm start unless the options say so, at its first update."""
    torch.manual_seed(0)
    given = dict(updates=60, updates_per_epoch=10, hidden=(16, 16), warm_start=0.0) | options
    if cls.watches:
        given = {"critic_updates": 30} | given
    agent: Any = cls(S, action_dim, cls.Options(**given), source=source)
    optimizers = agent.configure_optimizers()
    agent.optimizers = lambda **_: optimizers if len(optimizers) > 1 else optimizers[0]  # as Lightning's
    agent.manual_backward = lambda loss: loss.backward()
    agent.clip_gradients = lambda *_, **__: None
    agent.generator, agent.update_index, agent.clones = torch.Generator().manual_seed(0), 0, True
    if agent.watches:
        rows = DrawnRows(Transitions(linear_data(EPISODES), discount=agent.options.discount))
        agent.trust.begin(rows, agent.held_out_weights, 0, torch.device("cpu"))
    return agent


def imagining(cls: type[Any], **options: Any) -> Any:
    """As `hand_driven`, with a source of imagined rows that holds its stored rollouts."""
    agent = hand_driven(cls, source=imagined_batches(), **options)
    agent.source.begin(torch.ones(()))
    return agent


def make_batch(action_dim: int = A, *, real: int = B) -> Batch:
    """Eight rows of noise, of which the first ones are real."""
    generator = torch.Generator().manual_seed(1)
    return dict(
        observations=torch.randn(B, S, generator=generator),
        actions=torch.rand(B, action_dim, generator=generator) * 2 - 1,
        rewards=torch.randn(B, generator=generator),
        next_observations=torch.randn(B, S, generator=generator),
        discounts=torch.full((B,), 0.99),
        returns=torch.randn(B, generator=generator),
        tails=torch.zeros(B),
        following_observations=torch.randn(B, S, generator=generator),
        last_observations=torch.randn(B, S, generator=generator),
        real=(torch.arange(B) < real).float(),
    )


def made_rollouts(
    rewards: list[list[float]], *, lengths: list[int] | None = None, fallen: tuple[int, ...] = ()
) -> Rollouts:
    """Rollouts of rewards (H, B). Step t of rollout b is at the state 10 b + t, uncertain by a half.

    Args:
        rewards: of each step.
        lengths: steps that each rollout takes before it ends; None for all.
        fallen: rollouts that end with a fall.
    """
    values = torch.tensor(rewards)
    H, count = values.shape
    steps = torch.arange(H)[:, None]
    taken = torch.tensor(lengths or [H] * count)
    valid = steps < taken
    states = ((10.0 * torch.arange(count) + steps) * valid)[..., None].expand(H, count, S)
    terminated = torch.zeros(H, count, dtype=torch.bool)
    for rollout in fallen:
        terminated[taken[rollout] - 1, rollout] = True
    return Rollouts(
        observations=states,
        actions=torch.zeros(H, count, A),
        rewards=values * valid,
        next_observations=(states + 1.0) * valid[..., None],
        terminated=terminated,
        halted=torch.zeros_like(terminated),
        aleatoric=torch.zeros(H, count, S + 1),
        uncertainty=0.5 * valid,
        valid=valid,
    )


def imagination(fall_beyond: float = float("inf"), **options: Any) -> Imagination:
    """The linear world, in which robots fall where the first dimension passes a height; mean predictions."""
    plain: dict[str, Any] = dict(branches=4, history=2, mode="mean", posterior=0.0, novelty_limit=None) | options
    fell = lambda states: states[..., 0] > fall_beyond  # noqa: E731
    return Imagination(linear_world(), linear_data(EPISODES), fell, RolloutOptions(**plain))


def imagined_batches(stored: Rollouts | None = None, **options: Any) -> ImaginedBatches:
    """A source of mixed batches in the linear world; options are the source's own, and those of its rollouts."""
    own = {name: options.pop(name) for name in ("real_ratio", "refresh_every", "discount") if name in options}
    plain: dict[str, Any] = dict(real_ratio=0.75, refresh_every=0, discount=0.99) | own
    return ImaginedBatches(imagination(**options), stored or made_rollouts([[1.0] * 10]), **plain)


def states_of(rollouts: Rollouts) -> list[float]:
    """The first dimension of each state that was acted upon."""
    return rollouts.observations[rollouts.valid][:, 0].tolist()


def flat(tensors: dict[str, Tensor]) -> Tensor:
    """All weights of a state dict in a row."""
    return torch.cat([value.flatten().float() for value in tensors.values()])
