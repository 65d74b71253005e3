"""What a world model promises of a policy: returns of whole imagined episodes."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envtf_lit.imagination.buffer import Imagination
from envtf_lit.policy import Policy
from envtf_lit.world_models.unroll import lost, unroll

TAIL = 0.05  # share of the episodes that end below `Promise.low`, and above `Promise.high`
LONGEST = 1_000  # steps of an imagined episode that neither a fall nor the log's time limit ends


@dataclass(frozen=True)
class Promise:
    """Returns of imagined episodes, rewards cut to the range of the log's.

    Attributes:
        mean: over episodes.
        error: standard error of the mean; each episode runs in a world of its own, so that it holds the model's doubt.
        low, high: between which nine of ten episodes' returns lie.
        lost: share of the steps at which the model had left what it knows, or was overpaid (`Imagination`).
        steps: mean length of the episodes.
    """

    mean: float
    error: float
    low: float
    high: float
    lost: float
    steps: float


@torch.no_grad()
def promised(imagination: Imagination, policy: Policy, *, episodes: int, generator: torch.Generator) -> Promise:
    """Plays a policy's deterministic actions from recorded first states, in sampled worlds and with sampled steps.

    Args:
        imagination: the world model, whose `options.posterior` says how far worlds differ.
        policy: acts on (B, S).
        episodes: number of episodes.
        generator: of first states, worlds and steps.
    """
    options, device = imagination.options, imagination.starts.starts.device
    firsts = imagination.starts.at(imagination.starts.draw_firsts(episodes, generator), 0)
    state = firsts.begin(imagination.model, posterior=options.posterior, generator=generator)
    low, high = imagination.reward_range
    total = torch.zeros(episodes, dtype=torch.float64, device=device)
    ended = torch.zeros(episodes, dtype=torch.bool, device=device)
    steps, strayed = 0, 0

    def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
        return policy.act(observation, deterministic=True)

    def select(t: int, rows: Tensor) -> Tensor | None:
        over = ended[rows]
        return (~over).nonzero()[:, 0] if bool(over.any()) else None

    for step in unroll(
        imagination.model,
        state,
        act,
        imagination.longest(LONGEST),
        mode=options.mode,
        select=select,
        generator=generator,
    ):
        reward = step.prediction.reward.double().nan_to_num(nan=low)
        total[step.rows] += reward.clamp(low, high)
        ended[step.rows] = imagination.terminated(step.prediction.observation)
        beyond = lost(step.prediction, options.novelty_limit) | imagination.overpaid(step.prediction)
        steps, strayed = steps + len(step.rows), strayed + int(beyond.sum())
    error = float(total.std()) / math.sqrt(episodes)
    worst, best = total.quantile(torch.tensor([TAIL, 1.0 - TAIL], dtype=total.dtype, device=device)).tolist()
    return Promise(float(total.mean()), error, worst, best, lost=strayed / max(1, steps), steps=steps / episodes)
