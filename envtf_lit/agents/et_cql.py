"""The Environment Transformer's policies: conservative Q-learning on the log and on imagined rollouts."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from envtf_lit.actors import Actor
from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.advantages import AdvantageWeights
from envtf_lit.agents.combo import COMBO, ImaginingOptions, MixingOptions
from envtf_lit.agents.cql import CQL, ConservativeOptions
from envtf_lit.agents.frontier import Frontier
from envtf_lit.agents.networks import PlainStateValue
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Losses, Part, Phase
from envtf_lit.agents.trust import Trust, WatchedWarmStart
from envtf_lit.agents.trust_levels import CLONE, FRONTIER, LEVELS, TrustLevel
from envtf_lit.agents.value_gradient import BETAS, PLACES, ValueGradient, ValueGradientOptions
from envtf_lit.critics import Critics
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.errors import UserError
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare, Positive, Sharpness
from envtf_lit.options.schema import rare


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
class GuardedRolloutOptions(RolloutOptions):
    """Imagined paths of the value gradient: each in a world of its own, up to where the model leaves what it knows."""

    branches: Count = rare(1_500)
    horizon: Count = rare(1)
    value_expansion: Natural = rare(0)


@dataclass(frozen=True)
class ETCQLOptions(MixingOptions, ConservativeOptions):
    """Our own variant's options.

    Attributes:
        trust: how far the policy may leave what the log supports: `cautious`, `default`, or `bold`, which is for those
            who can try it in a simulator (`trust_levels.LEVELS`).
        beta: how much better rows are cloned more: with weights min(exp(beta A), 20), A a row's advantage over the log
            in units of its root mean square; 0 clones all alike, for logs of one noisy controller, whose better rows
            are lucky ones. Where states decide the log's actions it does nothing.
        critic_updates: before the value gradient, in which critics learn the clone's value on real rows and on those of
            `generate_rollouts`. All updates before are the warm start, whatever the common `warm_start` says.
        value_gradient: the end of the training, in which the actor follows the gradient through the world model.
    """

    cql_weight: NonNegative = 0.01
    sampled_actions: Count = rare(1)
    real_ratio: NonzeroShare = 0.5
    refresh_every: Natural = rare(0)
    trust: TrustLevel = "default"
    beta: Sharpness = 2.0
    critic_updates: Natural = 1_000
    rollouts: GuardedRolloutOptions = field(default_factory=GuardedRolloutOptions)
    value_gradient: ValueGradientOptions = field(default_factory=ValueGradientOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        gradient = self.value_gradient
        if gradient.horizon < self.rollouts.history:
            raise UserError(
                f"value_gradient.horizon is {gradient.horizon} and rollouts.history is {self.rollouts.history}: "
                "rollouts carried on take their history from the steps before, so take a horizon of at least that."
            )
        if gradient.updates + self.critic_updates > self.updates:
            raise UserError(
                f"value_gradient.updates is {gradient.updates} and critic_updates is {self.critic_updates}, of "
                f"{self.updates} updates in all: take fewer, or raise updates."
            )

    @property
    def warm_updates(self) -> int:
        return self.updates - self.critic_updates - self.value_gradient.updates

    @property
    def path_lengths(self) -> dict[str, int]:
        return super().path_lengths | {"value_gradient.horizon": self.value_gradient.horizon}

    def within(self, reach: int) -> Self:
        """The value gradient's horizon is cut likewise, though not below the history that paths carry on with."""
        horizon = min(self.value_gradient.horizon, max(reach, self.rollouts.history, 1))
        return replace(super().within(reach), value_gradient=replace(self.value_gradient, horizon=horizon))


class ETCQL(AdvantageWeights, COMBO):
    """Conservative Q-learning on the log and on long imagination, in one objective, as far as the log can be left.

    A clone of the better rows, stopped by held-out likelihood; critics that learn its conservative Q (COMBO's form) on
    real rows and on those of `generate_rollouts`; then `ValueGradient`: the actor climbs imagined returns that end in
    that Q, which goes on learning, under a constraint on its held-out likelihood.

    In the warm start critics fit returns that go on beyond truncations with the log's own value V, which the weights of
    better rows need, and not with target critics, as other actor-critics' do.
    """

    Options: ClassVar[type[PolicyOptions]] = ETCQLOptions
    label = "ET + CQL"
    watches = True
    cures: ClassVar[Mapping[str, str]] = {**COMBO.cures} | dict.fromkeys(
        ("imagined_value", "trust_weight"), "lower value_gradient.learning_rate, or shorten value_gradient.horizon"
    )
    options: ETCQLOptions  # pyright: ignore[reportIncompatibleVariableOverride]

    def build_networks(self) -> None:
        ActorCritic.build_networks(self)  # no temperature: nothing here asks for entropy
        o = self.options
        self.value = PlainStateValue(self.observation_dim, hidden=o.hidden, layer_norm=o.layer_norm)
        self.trust = Trust(self.actor)
        self.frontier = Frontier(self.actor, self.critics, 1 + PLACES)

    def build_phases(self) -> list[Phase]:
        o = self.options
        assert self.source is not None
        gradient = ValueGradient(self.source.imagination, o.value_gradient, LEVELS[o.trust])
        return [WatchedWarmStart(o.warm_updates, self.trust), Losses(o.critic_updates), gradient]

    def parts(self) -> dict[str, Part]:
        return dict(
            actor=Part(self.actor, self.options.actor_learning_rate),
            critics=Part(self.critics, self.options.critic_learning_rate),
            value=Part(self.value, self.options.critic_learning_rate),
            actor_by_gradient=Part(self.actor, self.options.value_gradient.learning_rate, BETAS),
        )

    def warm_start_losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """As of COMBO, and the log's own value; least squares join the clone's likelihood where states decide actions.

        What states decide cannot be done better in one row than in another.
        """
        loss = self.value_loss(batch)
        yield "value", loss, dict(value_loss=loss)
        for part, loss, logs in super().warm_start_losses(batch):
            if part == "actor" and self.trust.determined:
                loss = loss + self.actor.least_squares(batch["observations"], batch["actions"])
            yield part, loss, logs

    def clone_loss(self, batch: Batch) -> Tensor:
        """The weighted mean of the rows' errors; `batch` has complete returns."""
        weight = self.row_weights(batch)
        return (weight * self.actor.clone_error(batch["observations"], batch["actions"])).sum() / weight.sum()

    def row_weights(self, batch: Batch) -> Tensor:
        """(B,) what rows with complete returns count in cloning: all alike where states decide actions."""
        if self.trust.determined:
            return torch.ones_like(batch["returns"])
        return self.advantage_weights(batch, self.options.beta)

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """The critics' alone: the actor stays the clone until it follows the gradient."""
        loss, logs = self.critic_loss(batch)
        yield "critics", loss, logs

    def setup(self, stage: str) -> None:
        super().setup(stage)
        data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        if data.validation_rows is None:
            raise UserError(
                f"{self.label} watches its likelihood of held-out episodes, and none are held out: give the share of "
                "the episodes to hold out, held_out=0.1."
            )
        self.trust.begin(data.validation_rows, self.held_out_weights, self.seed, self.device)

    def held_out_weights(self, batch: Batch) -> Tensor:
        """(B,) what held-out rows count, as the log has them."""
        return self.row_weights(self.complete_returns(self.in_units(batch)))

    def published_critics(self) -> Critics:
        """Those of the actor that was kept, as they were when it was put on the frontier."""
        critics = super().published_critics()
        critics.stack.load_state_dict(self.frontier.critics[int(self.frontier.kept)].state_dict())
        return critics

    def records(self) -> dict[str, list[dict[str, Any]]]:
        """The frontier, as `frontier.csv`."""
        return {FRONTIER: self.frontier.rows()}

    def companions(self) -> dict[str, Actor]:
        """The clone, which the frontier's distances are measured from: what the log supports, to be tried first."""
        return {CLONE: self.trust.clone}
