"""Fine-tuning: the weights of a published world model as the start of another's training."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict

import torch

from envtf_lit.errors import UserError
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.transformer import EnvironmentTransformer


def start_from(
    model: EnvironmentTransformer | EnsembleDynamics, base: EnvironmentTransformer | EnsembleDynamics
) -> None:
    """Takes over the weights of a world model of the same kind.

    Of a transformer the blocks must be alike, and the model keeps its own normaliser, which knows its own data. A
    projection of the same dimensions is taken over too, rescaled so that in the data's own units the model predicts
    what the base does (variances as far as their bounds let them); others, such as those of another robot, begin anew.
    So do posterior, recalibration and tail. An ensemble takes over another of the same dimensions whole, its
    normaliser too.

    Raises:
        UserError: the two are of different kinds, or differ in what the weights mean.
    """
    if isinstance(model, EnvironmentTransformer) and isinstance(base, EnvironmentTransformer):
        _start_transformer(model, base)
    elif isinstance(model, EnsembleDynamics) and isinstance(base, EnsembleDynamics):
        _refuse_differences(model.arguments, base.arguments, base.arguments)
        model.load_state_dict(base.state_dict())
    else:
        raise UserError(f"it is of another kind, {type(base).__name__}; start from one of the same.")


def _refuse_differences(mine: Mapping[str, object], theirs: Mapping[str, object], names: Iterable[str]) -> None:
    for name in names:
        if mine[name] != theirs[name]:
            raise UserError(f"{name} is {theirs[name]} there and {mine[name]} here; leave it as it is there.")


@torch.no_grad()
def _start_transformer(model: EnvironmentTransformer, base: EnvironmentTransformer) -> None:
    same = ("layers", "heads", "width", "activation", "target")
    _refuse_differences(asdict(model.options), asdict(base.options), same)
    model.blocks.load_state_dict(base.blocks.state_dict())
    model.norm.load_state_dict(base.norm.state_dict())
    if model.observation_dim != base.observation_dim:
        return
    if model.action_dim == base.action_dim:
        (old_mean, old_std), (mean, std) = base.normaliser.input_scale(), model.normaliser.input_scale()
        model.embed.weight.copy_(base.embed.weight * (std / old_std))
        model.embed.bias.copy_(base.embed.bias + base.embed.weight @ ((mean - old_mean) / old_std))
    if model.head.weight.shape == base.head.weight.shape:
        _start_head(model, base)


def _start_head(model: EnvironmentTransformer, base: EnvironmentTransformer) -> None:
    """The base's output layer, rescaled from the targets' units there to those here."""
    old, new = base.normaliser, model.normaliser
    ratio = old.target_std / new.target_std  # (S + 1,)
    weights, biases = base.head.weight.split(len(ratio)), base.head.bias.split(len(ratio))
    mean = biases[0] * ratio + (old.target_mean - new.target_mean) / new.target_std
    model.head.weight.copy_(torch.cat([weights[0] * ratio[:, None], *weights[1:]]))
    model.head.bias.copy_(torch.cat([mean, *(bias + 2 * ratio.log() for bias in biases[1:])]))
