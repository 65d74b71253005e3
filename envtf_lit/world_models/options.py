"""The options of world models and of their training: one class a kind."""

from dataclasses import dataclass, fields
from typing import Literal

from envtf_lit.errors import UserError
from envtf_lit.options.numbers import Count, Natural, NonNegative, Positive, Share
from envtf_lit.options.schema import check_epochs, rare


@dataclass(frozen=True)
class ModelOptions:
    """The Environment Transformer's architecture and objective.

    Attributes:
        layers: transformer blocks.
        heads: attention heads; divides `width` into even parts.
        width: embedding dimension.
        context: tokens (steps) that attention reaches back, in training and in generation.
        dropout: probability, in the residual branches.
        activation: nonlinearity of the feed-forward layers.
        objective: `beta_nll` (Seitzer et al. 2022), `nll`, or `paper_mse` (the paper's sampled mse, which drives every
            variance to zero).
        target: `delta` predicts the scaled change of the state, `absolute` the z-scored next state (the paper's form).
        epistemic: where epistemic variance comes from: `laplace`, the posterior of the last layer, fitted after
            training; `head`, the paper's third head, trained with the rest; `none`.
        random_features: of the state-action pair, which the posterior of `laplace` sees beside the last hidden token:
            more detect out-of-distribution pairs better, and its time grows with their square.
        bounded: predictions stay within the range of the training data, widened by a tenth of it at either end, so that
            no rollout runs away.
    """

    layers: Count = 4
    heads: Count = 4
    width: Count = 128
    context: Count = 16
    dropout: Share = 0.0
    activation: Literal["relu", "gelu"] = rare("gelu")
    objective: Literal["beta_nll", "nll", "paper_mse"] = "beta_nll"
    target: Literal["delta", "absolute"] = "delta"
    epistemic: Literal["laplace", "head", "none"] = "laplace"
    random_features: Natural = rare(128)
    bounded: bool = False


@dataclass(frozen=True)
class TransformerOptions(ModelOptions):
    """The Environment Transformer and how it is trained.

    Attributes:
        updates: gradient steps in all, a multiple of `updates_per_epoch`.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: windows of `context` steps per gradient step.
        learning_rate: peak, reached after `warmup` of the updates, then a cosine to zero.
        warmup: share of the updates, in [0, 1).
        weight_decay: AdamW's, on matrices only.
        eps: AdamW's.
        gradient_clip: largest gradient norm.
    """

    updates: Count = 6_000
    updates_per_epoch: Count = 1_000
    batch_size: Count = 32
    learning_rate: Positive = 0.001
    warmup: Share = rare(0.05)
    weight_decay: NonNegative = rare(0.0001)
    eps: Positive = rare(0.00000001)
    gradient_clip: Positive = rare(1.0)

    def __post_init__(self) -> None:
        check_epochs(self)
        if self.width % (2 * self.heads):
            raise UserError(
                f"width is {self.width} and heads is {self.heads}: each head needs an even share, so take a width "
                f"that is a multiple of {2 * self.heads}."
            )
        if self.objective == "paper_mse" and self.epistemic != "head":
            raise UserError(
                f"objective is paper_mse and epistemic is {self.epistemic}: that objective trains the paper's third "
                "head, so set epistemic to head."
            )

    @property
    def model(self) -> ModelOptions:
        """Architecture and objective alone."""
        return ModelOptions(**{field.name: getattr(self, field.name) for field in fields(ModelOptions)})


@dataclass(frozen=True)
class EnsembleOptions:
    """The ensemble of Gaussian networks of MBPO, MOPO, COMBO and RAMBO, and how it is trained.

    Attributes:
        members: networks, each trained on a bootstrap resample of its own.
        elites: members of least held-out error, the ones that predict.
        hidden: units of each hidden layer.
        updates: gradient steps at most, a multiple of `updates_per_epoch`.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: rows per gradient step and member.
        learning_rate: Adam's.
        weight_decay: of each layer, the output layer last: half this times the squared weights is added to the loss.
        patience: epochs without a member whose held-out error falls by 1 %, after which training stops.
    """

    members: Count = 7
    elites: Count = 5
    hidden: tuple[Count, ...] = (200, 200, 200, 200)
    updates: Count = 100_000
    updates_per_epoch: Count = 500
    batch_size: Count = 256
    learning_rate: Positive = 0.001
    weight_decay: tuple[NonNegative, ...] = (0.000025, 0.00005, 0.000075, 0.000075, 0.0001)
    patience: Count = 5

    def __post_init__(self) -> None:
        check_epochs(self)
        if self.elites > self.members:
            raise UserError(
                f"elites is {self.elites} and members is {self.members}: elites are chosen from the members, so take "
                "no more than those."
            )
        if len(self.weight_decay) != len(self.hidden) + 1:
            raise UserError(
                f"weight_decay has {len(self.weight_decay)} entries and there are {len(self.hidden) + 1} layers, the "
                "output layer among them: give one for each."
            )


WorldModelOptions = TransformerOptions | EnsembleOptions
KINDS: dict[str, type[WorldModelOptions]] = {"transformer": TransformerOptions, "ensemble": EnsembleOptions}
