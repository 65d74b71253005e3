"""The options of world models and of their training."""

from dataclasses import dataclass, field
from typing import Literal

from envtf_lit.errors import UserError
from envtf_lit.options.schema import check_epochs


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
            more detect strange pairs better, and its time grows with their square.
        bounded: predictions stay within the range of the training data, widened by a tenth of it at either end, so that
            no rollout runs away.
    """

    layers: int = 4
    heads: int = 4
    width: int = 128
    context: int = 16
    dropout: float = 0.0
    activation: Literal["relu", "gelu"] = "gelu"
    objective: Literal["beta_nll", "nll", "paper_mse"] = "beta_nll"
    target: Literal["delta", "absolute"] = "delta"
    epistemic: Literal["laplace", "head", "none"] = "laplace"
    random_features: int = 128
    bounded: bool = False


@dataclass(frozen=True)
class EnsembleOptions:
    """The ensemble of Gaussian networks of MBPO, MOPO, COMBO and RAMBO, and how it is trained.

    Attributes:
        members: networks, each trained on a bootstrap resample of its own.
        elites: members of least held-out error, the ones that predict.
        hidden: units of each hidden layer.
        updates: gradient steps at most.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: rows per gradient step and member.
        learning_rate: Adam's.
        weight_decay: of each layer, the output layer last: half this times the squared weights is added to the loss.
        patience: epochs without a member whose held-out error falls by 1 %, after which training stops.
    """

    members: int = 7
    elites: int = 5
    hidden: tuple[int, ...] = (200, 200, 200, 200)
    updates: int = 100_000
    updates_per_epoch: int = 500
    batch_size: int = 256
    learning_rate: float = 0.001
    weight_decay: tuple[float, ...] = (0.000025, 0.00005, 0.000075, 0.000075, 0.0001)
    patience: int = 5


@dataclass(frozen=True)
class TrainModelOptions:
    """How the world model is trained.

    Attributes:
        model: architecture and objective.
        ensemble: a section trains the ensemble in place of the transformer, and of this section only `held_out` is
            read beside it; null trains the transformer.
        updates: gradient steps in all.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: windows of `model.context` steps per gradient step.
        learning_rate: peak, reached after `warmup` of the updates, then a cosine to zero.
        warmup: share of the updates, in [0, 1).
        weight_decay: AdamW's, on matrices only.
        eps: AdamW's.
        gradient_clip: largest gradient norm.
        held_out: share of the episodes kept for validation.
    """

    model: ModelOptions = field(default_factory=ModelOptions)
    ensemble: EnsembleOptions | None = None
    updates: int = 6_000
    updates_per_epoch: int = 1_000
    batch_size: int = 32
    learning_rate: float = 0.001
    warmup: float = 0.05
    weight_decay: float = 0.0001
    eps: float = 0.00000001
    gradient_clip: float = 1.0
    held_out: float = 0.1


def check_world_model(options: TrainModelOptions, section: str = "train_model") -> None:
    """The rules that tie the world model's options together; what an ensemble does not read may be anything.

    Args:
        options: of model and training.
        section: what errors call them.

    Raises:
        UserError: one is broken.
    """
    if options.ensemble is None:
        _check_model(f"{section}.model", options.model)
        check_epochs(section, options)
    else:
        check_epochs(f"{section}.ensemble", options.ensemble)
        _check_ensemble(f"{section}.ensemble", options.ensemble)


def _check_model(section: str, model: ModelOptions) -> None:
    if model.width % (2 * model.heads):
        raise UserError(
            f"{section}.width is {model.width} and heads is {model.heads}: each head needs an even share, so take a "
            f"width that is a multiple of {2 * model.heads}."
        )

    if model.objective == "paper_mse" and model.epistemic != "head":
        raise UserError(
            f"{section}.objective is paper_mse and epistemic is {model.epistemic}: that objective trains the paper's "
            "third head, so set epistemic to head."
        )


def _check_ensemble(section: str, options: EnsembleOptions) -> None:
    if options.elites > options.members:
        raise UserError(
            f"{section}.elites is {options.elites} and members is {options.members}: elites are chosen from the "
            "members, so take no more than those."
        )
    if len(options.weight_decay) != len(options.hidden) + 1:
        raise UserError(
            f"{section}.weight_decay has {len(options.weight_decay)} entries and there are {len(options.hidden) + 1} "
            "layers, the output layer among them: give one for each."
        )
