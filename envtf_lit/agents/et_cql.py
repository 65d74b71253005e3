"""The Environment Transformer's policies: conservative Q-learning on the log and on imagined rollouts."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from torch import Tensor

from envtf_lit.agents.combo import COMBO, ImaginingOptions
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Losses, Part, Phase
from envtf_lit.agents.value_gradient import (
    BETAS,
    LEARNING_RATE,
    StateValues,
    ValueGradient,
    ValueGradientOptions,
)
from envtf_lit.agents.warm_start import WarmStart
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare, Positive


@dataclass(frozen=True)
class PaperRolloutOptions(RolloutOptions):
    """The paper's rollouts: five steps, each learned from, whatever the model knows of its errors, at no penalty."""

    horizon: Count = 5
    value_expansion: Natural = 0
    posterior: NonNegative = 0.0
    novelty_limit: Positive | None = None


@dataclass(frozen=True)
class ETCQLPaperOptions(ImaginingOptions):
    """The paper's settings: a fixed buffer of one-step transitions, made by `generate_rollouts`, half of each batch."""

    real_ratio: NonzeroShare = 0.5
    refresh_every: Natural = 0
    rollouts: PaperRolloutOptions = field(default_factory=PaperRolloutOptions)


class ETCQLPaper(CQL):
    """The paper as written: both conservative terms on the mixture of real and imagined rows (equation 5)."""

    Options: ClassVar[type[PolicyOptions]] = ETCQLPaperOptions
    label = "ET + CQL (paper)"
    imagines = True
    options: ETCQLPaperOptions


@dataclass(frozen=True)
class ETCQLOptions(ImaginingOptions):
    """Our own variant's options.

    Attributes:
        value_gradient: the end of the training, in which the actor follows the gradient through the world model; null
            leaves all updates to CQL.
    """

    value_gradient: ValueGradientOptions | None = field(default_factory=ValueGradientOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        gradient = self.value_gradient
        if gradient is None:
            return
        if gradient.horizon < self.rollouts.history:
            raise UserError(
                f"value_gradient.horizon is {gradient.horizon} and rollouts.history is {self.rollouts.history}: "
                "rollouts carried on take their history from the steps before, so take a horizon of at least that."
            )
        if gradient.updates > self.updates - self.warm_updates:
            raise UserError(
                f"value_gradient.updates is {gradient.updates}, and {self.updates - self.warm_updates} updates come "
                "after the warm start: take no more than those."
            )

    @property
    def path_lengths(self) -> dict[str, int]:
        lengths, gradient = super().path_lengths, self.value_gradient
        return lengths if gradient is None else lengths | {"value_gradient.horizon": gradient.horizon}

    def within(self, reach: int) -> Self:
        """The value gradient's horizon is cut likewise, though not below the history that paths carry on with."""
        cut, gradient = super().within(reach), self.value_gradient
        if gradient is None:
            return cut
        horizon = min(gradient.horizon, max(reach, self.rollouts.history, 1))
        return replace(cut, value_gradient=replace(gradient, horizon=horizon))


class ETCQL(COMBO):
    """CQL in COMBO's form on data and fresh imagination, then the actor follows the gradient of imagined returns."""

    Options: ClassVar[type[PolicyOptions]] = ETCQLOptions
    label = "ET + CQL"
    cures: ClassVar[Mapping[str, str]] = {**COMBO.cures} | dict.fromkeys(
        ("imagined_value", "value_loss"), "lower value_gradient.learning_rate, or shorten value_gradient.horizon"
    )
    options: ETCQLOptions

    def build_networks(self) -> None:
        super().build_networks()
        if self.options.value_gradient is not None:
            self.values = StateValues(self.observation_dim)

    def build_phases(self) -> list[Phase]:
        o = self.options
        if o.value_gradient is None:
            return super().build_phases()
        assert self.source is not None
        warm, last = o.warm_updates, o.value_gradient.updates
        losses = Losses(o.updates - warm - last, scheduled=o.updates - warm)
        return [WarmStart(warm), losses, ValueGradient(self.source.imagination, self.values, o.value_gradient)]

    def parts(self) -> dict[str, Part]:
        gradient = self.options.value_gradient
        if gradient is None:
            return super().parts()
        return super().parts() | dict(
            actor_by_gradient=Part(self.actor, gradient.learning_rate, BETAS),
            value=Part(self.values.value, LEARNING_RATE),
        )

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """Beside critics and actor, the state value of the value gradient learns the log's returns."""
        yield from super().warm_start_losses(batch)
        if self.options.value_gradient is not None:
            yield "value", self.values.value_loss(batch["observations"], batch["returns"]), {}

    def end_warm_start(self) -> None:
        super().end_warm_start()
        if self.options.value_gradient is not None:
            self.values.target_value.load_state_dict(self.values.value.state_dict())
