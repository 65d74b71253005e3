"""Numbers in a range, the types that options are annotated with: jsonargparse's own, and a few more of its making."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # a type checker sees plain numbers
    Count = Natural = Rows = Frames = int
    Positive = NonNegative = Share = InnerShare = NonzeroShare = Sharpness = float
else:
    from jsonargparse.typing import (
        NonNegativeFloat,
        NonNegativeInt,
        OpenUnitInterval,
        PositiveFloat,
        PositiveInt,
        restricted_number_type,
    )

    Count, Natural = PositiveInt, NonNegativeInt
    Rows = restricted_number_type("Rows", int, (">=", 1_000))
    Frames = restricted_number_type("Frames", int, [(">=", 2), ("<=", 150)])
    Positive, NonNegative, InnerShare = PositiveFloat, NonNegativeFloat, OpenUnitInterval
    Share = restricted_number_type("Share", float, [(">=", 0), ("<", 1)])
    NonzeroShare = restricted_number_type("NonzeroShare", float, [(">", 0), ("<=", 1)])
    Sharpness = restricted_number_type("Sharpness", float, [(">=", 0), ("<=", 50)])  # exp(-it) is no zero in fp32

__all__ = [
    "Count",
    "Frames",
    "InnerShare",
    "Natural",
    "NonNegative",
    "NonzeroShare",
    "Positive",
    "Rows",
    "Share",
    "Sharpness",
]
