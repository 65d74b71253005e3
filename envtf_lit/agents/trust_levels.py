"""Levels of trust, and what a frontier's table holds: all that a reader of results needs to know of them."""

from dataclasses import dataclass
from typing import Literal

FRONTIER, CLONE = "frontier", "clone"  # the table and the actor beside a published policy
COLUMNS = ("update", "excess", "promise", "error", "low", "high", "lost", "steps")
LEAST_GAIN = 0.05  # of what is promised of the clone: what less is promised for is not worth leaving the log


@dataclass(frozen=True)
class Level:
    """A level of trust.

    Attributes:
        slack: nats per action dimension that an actor may be less likely than the clone, at the end.
        price: what must be promised for each nat of distance, in multiples of what is promised of the clone.
        believes: rewards above any recorded one are taken as the model says; else a path ends where it promises one.
    """

    slack: float
    price: float
    believes: bool = False


LEVELS = {"cautious": Level(0.1, 2.0), "default": Level(0.3, 1.0), "bold": Level(0.6, 0.0, believes=True)}
TrustLevel = Literal["cautious", "default", "bold"]
