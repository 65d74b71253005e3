"""RAMBO (Rigter et al. 2022): the world model learns to be unkind to the policy, within what the log allows."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from envtf_lit.agents.model_based import ModelBased, ModelBasedOptions
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.loaders import Windows
from envtf_lit.errors import UserError
from envtf_lit.imagination.histories import Histories
from envtf_lit.options.numbers import Count, Natural, NonNegative, NonzeroShare, Positive
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import Prediction, WorldModel
from envtf_lit.world_models.observed import ClippedWorld, bare
from envtf_lit.world_models.transformer import EnvironmentTransformer

Learner = EnsembleDynamics | EnvironmentTransformer


@dataclass(frozen=True)
class RAMBOOptions(ModelBasedOptions):
    """RAMBO's own options; its cloning before all else is the common `warm_start`.

    Attributes:
        adversarial_weight: lambda, of the model's unkindness beside its fit to the log.
        adversarial_every: updates of the policy between two rounds of updates of the model.
        adversarial_updates: of the model in each round.
        model_learning_rate: Adam's, of the model.
    """

    real_ratio: NonzeroShare = 0.5
    refresh_every: Natural = 250
    adversarial_weight: NonNegative = 0.0003
    adversarial_every: Count = 1_000
    adversarial_updates: Natural = 1_000
    model_learning_rate: Positive = 0.0003


class RAMBO(ModelBased):
    """Soft actor-critic against a model that lowers the policy's value: a game of two, on a copy of the model."""

    Options: ClassVar[type[PolicyOptions]] = RAMBOOptions
    label = "RAMBO"
    options: RAMBOOptions

    def build_networks(self) -> None:
        super().build_networks()
        imagination = self.source.imagination
        given = imagination.model
        self.model = learning_copy(bare(given))
        imagination.model = ClippedWorld(self.model, given.first) if isinstance(given, ClippedWorld) else self.model

    def setup(self, stage: str) -> None:
        super().setup(stage)
        data: TransitionData = self.trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
        self.windows = Windows(data.dataset, context_of(self.model), self.trainer.strategy.root_device)

    def on_train_epoch_start(self) -> None:
        self.model.eval()  # dropout would be noise in what is imagined; Lightning has all begin in training mode
        super().on_train_epoch_start()

    def parts(self) -> dict[str, Part]:
        return super().parts() | dict(model=Part(self.model, self.options.model_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        """Those of soft actor-critic; at the end of each stretch of updates the model has its round before them."""
        o = self.options
        if self.update_index % o.adversarial_every == o.adversarial_every - 1:
            for k in range(o.adversarial_updates):
                yield "model", *self.model_loss(depth=k % o.rollouts.horizon)
        yield from super().losses(batch)

    def model_loss(self, depth: int) -> tuple[Tensor, Logs]:
        """`lambda E[A log T(s', r | s, a)] - E_log[log T]` (equation 10), s after `depth` imagined steps."""
        o = self.options
        drawn = torch.randint(len(self.windows), (o.batch_size,), generator=self.generator, device=self.device)
        with torch.autocast(self.device.type, enabled=False):
            observation, prediction, stands = self.imagined_step(depth)
            advantage = self.advantage(*observation, prediction, stands)
            adversarial = adversarial_loss(prediction.log_prob, advantage, stands)
            fit = self.model.loss(self.windows[drawn])
            return o.adversarial_weight * adversarial + fit, dict(adversarial_loss=adversarial, model_loss=fit)

    def imagined_step(self, depth: int) -> tuple[tuple[Tensor, Tensor], Prediction, Tensor]:
        """(s, a), the differentiable prediction of what follows, and (B,) bool, where the robot had not fallen before.

        The policy acts from real states on; what it has been through on the way is without gradient.
        """
        imagination, options = self.source.imagination, self.options.rollouts
        histories: Histories = imagination.starts.draw(self.options.batch_size, options.history, self.generator)
        model, generator = imagination.model, self.generator  # the copy that learns, whose kind does not matter here
        stands = torch.ones(len(histories), dtype=torch.bool, device=histories.lengths.device)
        with torch.no_grad():
            state = histories.begin(model, posterior=options.posterior, generator=generator)
            for _ in range(depth):
                action = self.actor.act(model.current(state), deterministic=False, generator=generator)
                state, prediction = model.step(state, action, mode="sample", generator=generator)
                stands &= ~imagination.terminated(prediction.observation)
        observation = model.current(state)
        action = self.actor.act(observation, deterministic=False, generator=generator)
        _, prediction = model.step(state, action, mode="sample", generator=generator)
        return (observation, action), prediction, stands

    @torch.no_grad()
    def advantage(self, observation: Tensor, action: Tensor, prediction: Prediction, stands: Tensor) -> Tensor:
        """(B,) `A = r + gamma V(s') - Q(s, a)`, standardised over the robots that stand (proposition 2)."""
        following, reward = prediction.observation, prediction.reward / self.return_scale
        goes_on = ~self.source.imagination.terminated(following)
        value = self.critics(following, self.actor.act(following)).min(0).values
        advantage = reward + self.options.discount * goes_on * value
        advantage = advantage - self.critics(observation, action).min(0).values
        count = stands.sum().clamp(min=1)
        centred = advantage - (stands * advantage).sum() / count
        return centred / ((stands * centred.square()).sum() / count).sqrt().clamp(min=1e-6)


def adversarial_loss(log_density: Tensor, advantage: Tensor, stands: Tensor) -> Tensor:
    """`mean A log T(s', r | s, a)` over the robots that stand; all (B,), for (B,) x (B, 1) would cancel the gradient.

    The log-density is that of the mixture of joint densities, over all dimensions of one member first.
    """
    assert log_density.shape == advantage.shape == stands.shape and stands.dim() == 1
    return (stands * advantage * log_density).sum() / stands.sum().clamp(min=1)


def context_of(model: Learner) -> int:
    """Steps that a model's own loss looks at together."""
    return model.options.context if isinstance(model, EnvironmentTransformer) else 1


def learning_copy(model: WorldModel) -> Learner:
    """A copy of a world model that can be trained; the given one stays as it is.

    Raises:
        UserError: the model's log-density has no gradient in its weights, or its steps are compiled: a copy would call
            those of the original.
    """
    compiled = {"step", "predict"} & vars(model).keys()
    if not isinstance(model, EnsembleDynamics | EnvironmentTransformer) or compiled:
        raise UserError(
            "RAMBO trains a copy of its world model along the gradient of the log-density, and this one gives none: "
            "take an ensemble or a transformer, and set compile to false, since compiled steps stay with the original."
        )
    return copy.deepcopy(model).requires_grad_(True).train()
