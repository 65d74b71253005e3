"""Whether one policy does better than another, from episodes that begin alike."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

Verdict = Literal["better", "worse", "not clearly different"]


@dataclass(frozen=True)
class Comparison:
    """The difference between two policies over the same starts.

    Attributes:
        gain: mean of the first policy's result less the second's.
        standard_error: of the gain, over starts; infinite where there is one start alone.
        starts: how many.
        verdict: on the first policy; `not clearly different` within twice the standard error, or the least difference.
    """

    gain: float
    standard_error: float
    starts: int
    verdict: Verdict


def compare(first: np.ndarray, second: np.ndarray, *, least: float = 0.0) -> Comparison:
    """The first policy against the second.

    Args:
        first: (E,) scores or returns of its episodes.
        second: (E,) of the other's, from the same starts in the same order.
        least: difference that must be passed to count, whatever the standard error.
    """
    difference = np.asarray(first, dtype=np.float64) - np.asarray(second, dtype=np.float64)
    starts, gain = len(difference), float(difference.mean())
    error = float(difference.std(ddof=1)) / math.sqrt(starts) if starts > 1 else math.inf
    clear = abs(gain) > max(least, 2 * error)
    verdict: Verdict = "not clearly different" if not clear else "better" if gain > 0 else "worse"
    return Comparison(gain, error, starts, verdict)
