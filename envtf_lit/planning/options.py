"""The options of planners: one class a family."""

from dataclasses import dataclass
from typing import Literal

from envtf_lit.errors import UserError
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare, Positive, Share


@dataclass(frozen=True)
class PlannerOptions:
    """What planners of all families have.

    Attributes:
        horizon: steps of a plan.
        discount: of future rewards, per step.
        mode: plans are judged by mean predictions (`mean`) or by one draw each (`sample`).
        warm_start: the search begins at what the plan before has left, not at the middle of the action range.
        tail: steps after the plan in which a candidate goes on as the prior would; what they pay counts. A short plan
            with a long tail asks what may be done better now by one who then goes on as before (a rollout, Bertsekas
            2020), and is not blind to what comes after the horizon.
        penalty: what a unit of the predictions' uncertainty u costs, in the reward's own units, at each step.
        novelty_limit: a candidate is given up where the model's epistemic variance passes this multiple of its 0.999
            quantile over the training data; each step that it lacks then counts as the worst that any candidate met.
            null trusts the model everywhere.
    """

    horizon: Count = 15
    discount: NonzeroShare = 0.99
    mode: Literal["mean", "sample"] = "mean"
    warm_start: bool = True
    tail: Natural = 0
    penalty: NonNegative = 0.0
    novelty_limit: Positive | None = None


@dataclass(frozen=True)
class RandomShootingOptions(PlannerOptions):
    """Random shooting: the best of plans drawn uniformly from the action range.

    Attributes:
        samples: candidates.
    """

    samples: Count = 512


@dataclass(frozen=True)
class CEMOptions(PlannerOptions):
    """The cross-entropy method (Rubinstein 1999; PETS, Chua et al. 2018).

    Attributes:
        samples: candidates in each round.
        iterations: rounds.
        elites: best candidates of a round, to which the next one's Gaussian is fitted.
        std: standard deviation of the first round, in units of half the action range.
        momentum: share of the old mean and standard deviation in the new ones.
    """

    samples: Count = 128
    iterations: Count = 4
    elites: Count = 12
    std: Positive = 0.7
    momentum: Share = 0.1

    def __post_init__(self) -> None:
        if self.elites > self.samples:
            raise UserError(
                f"elites is {self.elites} and samples is {self.samples}: elites are chosen from the samples, so take "
                "no more than those."
            )


@dataclass(frozen=True)
class ICEMOptions(CEMOptions):
    """iCEM (Pinneri et al. 2020): CEM with noise that is correlated in time, fewer candidates, and elites that stay.

    Attributes:
        colour: exponent of the noise's spectrum `1 / f^colour`: 0 is white, 1 pink, 2 brown.
        decay: each round has the samples of the one before divided by this, at least twice the elites; 1 or more.
        kept: share of the elites that are candidates of the next round, and, shifted, of the next plan's first.
    """

    colour: NonNegative = 2.0
    decay: Positive = 1.25
    kept: NonzeroShare = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.decay < 1:
            raise UserError(f"decay is {self.decay}: rounds become smaller, so take 1 or more.")


@dataclass(frozen=True)
class MPPIOptions(PlannerOptions):
    """Model-predictive path integral control (Williams et al. 2017): candidates weigh `exp(return / temperature)`.

    Attributes:
        samples: candidates in each round.
        iterations: rounds.
        std: standard deviation of the noise, in units of half the action range.
        temperature: of the weights, in the reward's own units.
        colour: as of iCEM.
    """

    samples: Count = 256
    iterations: Count = 1
    std: Positive = 0.5
    temperature: Positive = 1.0
    colour: NonNegative = 0.0


@dataclass(frozen=True)
class GradientOptions(PlannerOptions):
    """Gradient ascent on the plan, by backpropagation through the model; the best of several starts is taken.

    Attributes:
        samples: plans that are improved side by side: the warm one, and others about it.
        iterations: of Adam.
        learning_rate: Adam's, in units of half the action range.
        std: standard deviation of the other starts about the warm one, in those units.
    """

    samples: Count = 16
    iterations: Count = 5
    learning_rate: Positive = 0.3
    std: Positive = 0.7
