"""Small world models whose predictions can be worked out by hand, and sources of rows imagined in them."""

from typing import Any

import torch
from torch import Tensor, nn

from envtf_lit.imagination.buffer import Imagination, ImaginedBatches
from envtf_lit.imagination.options import RolloutOptions
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import linear_data
from tests.hand_driven import EPISODES, A, S, made_rollouts


def linear_gaussians(members: int = 3, *, alike: bool = False) -> EnsembleDynamics:
    """An ensemble without hidden layers: means and log-variances are linear in the z-scored pair."""
    torch.manual_seed(0)
    model = EnsembleDynamics(S, A, members=members, elites=members, hidden=())
    with torch.no_grad():
        model.weights[0] *= 0.5
        model.biases[0][..., S + 1 :] = -2.0  # standard deviations of about a third
        for weight in (model.weights[0], model.biases[0]):
            weight[..., : S + 1] += 0.2 * torch.randn_like(weight[..., : S + 1])
            if alike:
                weight.copy_(weight[:1].expand_as(weight))
    model.normaliser.target_std.copy_(torch.tensor([1.0, 2.0, 0.5, 3.0]))
    model.normaliser.observation_mean.copy_(torch.tensor([0.1, -0.2, 0.0]))
    return model.eval()


def small_transformer(epistemic: str = "laplace") -> EnvironmentTransformer:
    """One block of width eight, with a posterior if wanted, not fitted yet."""
    torch.manual_seed(0)
    options: dict[str, Any] = dict(layers=1, heads=2, width=8, context=4, random_features=4)
    return EnvironmentTransformer(S, A, epistemic=epistemic, **options).eval()


def source_in(model: WorldModel, stored: Rollouts | None = None, **options: Any) -> ImaginedBatches:
    """A source of mixed batches in a world model, in which no robot falls."""
    plain: dict[str, Any] = dict(branches=4, horizon=2, value_expansion=0, history=2, posterior=0.0, novelty_limit=None)
    never = lambda states: torch.zeros(states.shape[:-1], dtype=torch.bool)  # noqa: E731
    imagination = Imagination(model, linear_data(EPISODES), never, RolloutOptions(**plain | options))
    stored = made_rollouts([[1.0, -2.0], [3.0, 0.5]]) if stored is None else stored
    return ImaginedBatches(imagination, stored, real_ratio=0.5, refresh_every=0, discount=0.99)


class StateCritics(nn.Module):
    """Q_i(s, a) = s_0 + i, and a's share of it if wanted."""

    def __init__(self, action: float = 0.0) -> None:
        super().__init__()
        self.action = action

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return torch.arange(2.0)[:, None] + observation[:, 0] + self.action * action[:, 0]
