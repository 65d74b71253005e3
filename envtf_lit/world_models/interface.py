"""The world-model interface, all that imagination and evaluation see: a batched simulator, and what it predicts."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from envtf_lit.errors import UserError

Mode = Literal["mean", "sample"]


@dataclass(frozen=True)
class Prediction:
    """Predictive distribution of one step, and an outcome of it, for B rows; in the data's units unless said otherwise.

    Attributes:
        observation: (B, S) next state.
        reward: (B,).
        mean: (B, S + 1) the predictive mean of (next observation, reward).
        aleatoric: (B, S + 1) standard deviation of (next observation, reward) from the data's own noise; with a `tail`,
            of the Gaussian that has the same 90 % interval.
        epistemic: (B, S + 1) standard deviation from lack of data, or None where the model has no such estimate.
        uncertainty: (B,) `||sqrt(S_au + S_eu)||_2 / sqrt(S)` over z-scored live observation dimensions: the penalty u.
        novelty: (B,) epistemic variance as a multiple of its 0.999 quantile over the training data: beyond 1 the model
            has left what it knows. None where the model has no such estimate.
        log_prob: (B,) log-density of (observation, reward) under the predictive distribution; gradients reach the
            distribution alone, not the draw.
        tail: (S + 1,) how heavy the tails of the predictive distribution are (`world_models.tails`); None: Gaussian.
    """

    observation: Tensor
    reward: Tensor
    mean: Tensor
    aleatoric: Tensor
    epistemic: Tensor | None
    uncertainty: Tensor
    novelty: Tensor | None
    log_prob: Tensor
    tail: Tensor | None = None


class WorldModel(Protocol):
    """Interface of a batched, seeded simulator with an explicit state.

    States are consumed: after `step` only the returned state is valid, since caches are written in place.
    """

    observation_dim: int
    action_dim: int

    def init(
        self,
        observations: Tensor,
        actions: Tensor,
        lengths: Tensor,
        window: Tensor | None = None,
        *,
        posterior: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Any:
        """Starts B rollouts from histories.

        Args:
            observations: (W, T, S) windows of a log, right-padded.
            actions: (W, T - 1, A), right-padded; a rollout's current state has no action yet.
            lengths: (B,) observations of its window that each rollout has seen, 1 to T; the last is its present one.
            window: (B,) the window of each rollout; None where each has one of its own, W = B. Many rollouts that begin
                in one window cost no more reading than one.
            posterior: above zero each rollout runs, from end to end, in a model of its own, drawn from the posterior
                with its deviation from the mean model times this (1: as it is).
            generator: of those draws.

        Raises:
            UserError: `posterior` is above zero and the model has none.
        """
        ...

    def step(
        self, state: Any, action: Tensor, *, mode: Mode = "mean", generator: torch.Generator | None = None
    ) -> tuple[Any, Prediction]:
        """Acts with (B, A) in every row; the next observation is the mean, or a draw with `generator`."""
        ...

    def observe(self, state: Any, observation: Tensor) -> Any:
        """Replaces the current observation (B, S) by what was really seen (teacher forcing, online use)."""
        ...

    def current(self, state: Any) -> Tensor:
        """The current observation (B, S) of a state."""
        ...

    def fork(self, state: Any, n: int) -> Any:
        """Each row n times, in order: row b becomes rows b*n … b*n + n - 1."""
        ...

    def gather(self, state: Any, index: Tensor) -> Any:
        """The rows of these indices (K,), in the order given."""
        ...

    def same_worlds(self, state: Any, former: Any, rows: Tensor) -> Any:
        """A state of `init` in which these rows (B,) bool run in the drawn models that those of `former` ran in.

        For rollouts that are carried on from a history of their own. `former` may have been consumed.
        """
        ...


def as_rows(what: str, given: Tensor | ArrayLike, shape: tuple[int | None, ...], device: torch.device) -> Tensor:
    """What a world model was given, as a tensor of numbers in single precision or less.

    Args:
        what: observations or actions.
        given: a tensor, which stays where it lies; an array or lists of numbers are copied.
        shape: that it must have; None where any size will do.
        device: of what is copied.

    Raises:
        UserError: it has another shape, or is no numbers.
    """
    if not isinstance(given, Tensor):
        try:
            given = torch.from_numpy(np.array(given, np.float32)).to(device)
        except (TypeError, ValueError):
            raise UserError(
                f"The world model was given {what} that make no array of numbers: give rows of equal length."
            ) from None
    if given.dtype == torch.float64 or not given.is_floating_point():
        given = given.float()
    if given.dim() != len(shape) or any(
        asked is not None and size != asked for size, asked in zip(given.shape, shape, strict=True)
    ):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        lone = given.dim() == len(shape) - 1
        cure = "the first axis is of robots, so give a single one's as [x]" if lone else "give as many numbers"
        raise UserError(
            f"The world model takes {what} of shape ({wanted}) here, and was given {tuple(given.shape)}: {cure}."
        )
    return given


def as_histories(
    observations: Tensor | ArrayLike,
    actions: Tensor | ArrayLike,
    lengths: Tensor | ArrayLike,
    window: Tensor | ArrayLike | None,
    sizes: tuple[int, int],
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Observations, actions, lengths and windows of `WorldModel.init`, as tensors that fit each other.

    Args:
        observations, actions, lengths, window: see there.
        sizes: S and A.
        device: of what is no tensor yet.

    Raises:
        UserError: they do not fit each other, or a length is none of its window's.
    """
    observations = as_rows("observations", observations, (None, None, sizes[0]), device)
    W, T = observations.shape[:2]
    if T == 0:
        raise UserError("The world model was given histories of no observations: each ends with the present one.")
    actions = as_rows("actions between them", actions, (W, T - 1, sizes[1]), device)
    lengths = _whole("lengths", lengths, device)
    window = torch.arange(W, device=lengths.device) if window is None else _whole("windows", window, device)
    if lengths.shape != window.shape:
        raise UserError(
            f"The world model was given {tuple(lengths.shape)} lengths for {len(window)} rollouts: give one number for "
            "each, how many of its observations it has seen."
        )
    on_cpu = lengths.device.type == "cpu"  # elsewhere to look would be to wait
    if on_cpu and not ((lengths >= 1) & (lengths <= T)).all():
        raise UserError(
            f"The world model was given histories of {lengths.tolist()} observations, and its windows have {T}: a "
            f"rollout has seen from 1, the present one, to {T}."
        )
    if on_cpu and not ((window >= 0) & (window < W)).all():
        raise UserError(f"The world model was given windows {window.tolist()} of {W}: they are numbered from 0.")
    return observations, actions, lengths, window


def _whole(name: str, numbers: Tensor | ArrayLike, device: torch.device) -> Tensor:
    """Numbers of observations or of windows."""
    try:
        found = numbers if isinstance(numbers, Tensor) else torch.from_numpy(np.array(numbers)).to(device)
    except (TypeError, ValueError):
        found = None
    if found is None or (found.is_floating_point() and found.numel() > 0):
        raise UserError(f"The world model was given {name} {numbers}: give whole numbers, one for each rollout.")
    return found.long()
