"""Where an Environment Transformer looks: the weights of its attention, token by token and by steps back."""

from typing import cast

import torch
from torch import Tensor

from envtf_lit.world_models.attention import Block, rotation, window_mask
from envtf_lit.world_models.transformer import EnvironmentTransformer


@torch.no_grad()
def attention_weights(model: EnvironmentTransformer, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """The weights with which each token mixes the values of those before it, and of itself.

    Args:
        model: in eval mode.
        observations: (B, T, S).
        actions: (B, T, A).

    Returns:
        (B, L, H, T, T) weights of each layer and head, in [0, 1]: a row is one token's, and sums to one. And the last
        hidden tokens (B, T, D) that come of mixing with them.
    """
    T, found = observations.shape[1], list[Tensor]()
    mask = window_mask(T, model.options.context, observations.device)
    cos_sin = rotation(torch.arange(T, device=observations.device), model.options.width // model.options.heads)
    x = model.embed(model.normaliser.token(observations, actions))
    for block in cast(list[Block], list(model.blocks)):
        q, k, v = block.attention.project(block.attention_norm(x), cos_sin)
        score = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).masked_fill(~mask, float("-inf"))  # (B, H, T, T)
        found.append(score.softmax(-1))
        x = block.finish(x, block.attention.out((found[-1] @ v).transpose(1, 2).flatten(2)))
    return torch.stack(found, 1), model.norm(x)


def by_steps_back(weights: Tensor, context: int) -> Tensor:
    """(L, H, C) mean weight on the token 0, 1, … C - 1 steps back, over the tokens that have so many before them.

    Args:
        weights: (B, L, H, T, T) of `attention_weights`, of stretches longer than the context.
        context: C.
    """
    T = weights.shape[-1]
    later = range(context - 1, T)
    return torch.stack([weights[..., t, t - context + 1 : t + 1].flip(-1) for t in later]).mean((0, 1))
