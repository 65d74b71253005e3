"""The worlds that a model holds possible: an ensemble's elites, or draws from a transformer's posterior."""

import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.transformer import EnvironmentTransformer

DRAWS = 5  # worlds from a posterior: as many as an ensemble has elites


def check_members(model: WorldModel) -> None:
    """Whether a model holds several worlds possible.

    Raises:
        UserError: it doesn't.
    """
    ensemble = isinstance(model, EnsembleDynamics) and len(model.elite) > 1
    posterior = isinstance(model, EnvironmentTransformer) and model.laplace is not None
    if not ensemble and not posterior:
        raise UserError(
            "This world model holds one world possible, and its disagreement with others is asked for: take an "
            "ensemble of two elites or more, or a transformer trained with epistemic: laplace."
        )


@torch.no_grad()
def member_predictions(
    model: WorldModel, observation: Tensor, action: Tensor, *, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Mean and aleatoric standard deviation of the next state in each of M worlds, each (M, B, S), in raw units.

    A transformer sees the pair alone, without history, and each row has worlds of its own.

    Args:
        model: an ensemble, or a transformer with a posterior.
        observation: (B, S).
        action: (B, A).
        generator: of draws from the posterior.

    Raises:
        UserError: the model holds one world possible.
    """
    check_members(model)
    if isinstance(model, EnsembleDynamics):
        means, log_variances = (x[model.elite] for x in model(model.normaliser.token(observation, action)))
        outcome = model.normaliser.outcome(observation, means)
        return outcome[..., :-1], (torch.exp(0.5 * log_variances) * model.normaliser.target_std)[..., :-1]
    B = len(observation)
    window = torch.arange(B, device=observation.device).repeat(DRAWS)
    begin = observation[:, None], action[:, :0, None].expand(B, 0, action.shape[1])
    state = model.init(*begin, torch.ones_like(window), window, posterior=1.0, generator=generator)
    _, prediction = model.step(state, action.repeat(DRAWS, 1))
    means, stds = prediction.observation, prediction.aleatoric[..., :-1]
    return means.unflatten(0, (DRAWS, B)), stds.unflatten(0, (DRAWS, B))
