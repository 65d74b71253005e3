"""A small transformer that has not been trained, and batches for it."""

import torch

from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer

S, A = 5, 2


def make_model(**options) -> EnvironmentTransformer:
    """Two layers with a window of six steps, away from the near-zero initialisation, so that attention matters."""
    torch.manual_seed(0)
    model = EnvironmentTransformer(S, A, **(dict(layers=2, heads=2, width=16, context=6) | options)).eval()
    for parameter in model.parameters():
        parameter.data.add_(0.3 * torch.randn_like(parameter))
    model.normaliser.target_std.copy_(torch.linspace(0.5, 2.0, S + 1))
    model.normaliser.observation_mean.copy_(torch.linspace(-1.0, 1.0, S))
    return model


def sequences(batch: int, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations (batch, length, S) and actions (batch, length, A) of noise."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(batch, length, S, generator=generator), torch.randn(batch, length, A, generator=generator)


def batch_of(observations: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    """What the loss takes: windows (B, T, …) without padding."""
    B, T, _ = observations.shape
    return dict(
        observations=observations,
        actions=actions,
        next_observations=observations + 0.1,
        rewards=torch.ones(B, T),
        mask=torch.ones(B, T),
    )


def one_step(model: EnvironmentTransformer) -> Prediction:
    """A prediction from the origin."""
    with torch.no_grad():
        state = model.init(torch.zeros(1, 1, S), torch.zeros(1, 0, A), torch.ones(1).long())
        return model.step(state, torch.zeros(1, A))[1]
