"""MOBILE by hand: what worlds disagree on, targets that pay for it, and models that hold one world possible."""

from typing import Any

import pytest
import torch

from envtf_lit.agents.mobile import MOBILE
from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.uncertainty.members import DRAWS, member_predictions
from tests.analytic import linear_world
from tests.hand_driven import B, S, hand_driven, make_batch
from tests.worlds import StateCritics, linear_gaussians, small_transformer, source_in


def mobile_in(model: WorldModel, **options: Any) -> Any:
    return hand_driven(MOBILE, source=source_in(model), **options)


def posterior(scale: float) -> WorldModel:
    """A transformer whose last layer is uncertain."""
    model = small_transformer()
    assert model.laplace is not None
    model.laplace.root.copy_(torch.eye(len(model.laplace.root)))
    model.laplace.residual.fill_(1.0)
    model.laplace.scale.fill_(scale)
    return model


def test_identical_members_give_zero() -> None:
    """Though each draws ten states, and the policy an action in each."""
    agent, batch = mobile_in(linear_gaussians(alike=True)), make_batch()
    agent.target_critics = StateCritics(action=3.0)
    assert (agent.inconsistency(batch["observations"], batch["actions"]) == 0).all()


def test_a_posterior_without_spread_gives_zero_and_one_with_more_gives_more() -> None:
    batch, found = make_batch(), []
    for scale in (0.0, 0.01, 1.0):
        agent = mobile_in(posterior(scale))
        agent.target_critics = StateCritics()
        found.append(agent.inconsistency(batch["observations"], batch["actions"]))
    assert found[0].abs().max() < 1e-6
    assert (found[1] > 1e-4).all() and (found[2] > found[1]).all()


def test_u_is_the_deviation_of_the_members_mean_values() -> None:
    """Where Q is linear in the state and members differ in their means alone, draws cancel."""
    model = linear_gaussians()
    with torch.no_grad():
        for weight in (model.weights[0], model.biases[0]):
            weight[..., S + 1 :] = weight[:1, ..., S + 1 :].expand_as(weight[..., S + 1 :])
    agent, batch = mobile_in(model), make_batch()
    agent.target_critics = StateCritics()
    means, _ = model(model.normaliser.token(batch["observations"], batch["actions"]))
    expected = (batch["observations"][:, 0] + means[..., 0] * model.normaliser.target_std[0]).std(0)
    torch.testing.assert_close(agent.inconsistency(batch["observations"], batch["actions"]), expected)


def test_imagined_rows_alone_pay_and_targets_may_be_negative() -> None:
    agent, batch = mobile_in(linear_gaussians(), bellman_penalty=2.0), make_batch(real=3)
    agent.target_critics = StateCritics()
    batch["rewards"] -= 100.0
    target = agent.td_target(batch)
    agent.generator.manual_seed(0)
    agent.actor.sample(batch["next_observations"], generator=agent.generator)
    u = agent.inconsistency(batch["observations"], batch["actions"])
    expected = batch["rewards"] + 0.99 * batch["next_observations"][:, 0] - 2.0 * u * (torch.arange(B) >= 3)
    torch.testing.assert_close(target, expected)
    assert (target < -50).all() and (u > 0).all()


def test_members_of_an_ensemble_are_its_elites() -> None:
    model, batch = linear_gaussians(members=4), make_batch()
    model.elite = torch.tensor([3, 1])
    means, stds = member_predictions(model, batch["observations"], batch["actions"])
    every, log_variances = model(model.normaliser.token(batch["observations"], batch["actions"]))
    scale = model.normaliser.target_std[:-1]
    torch.testing.assert_close(means, batch["observations"] + every[[3, 1], :, :-1] * scale)
    torch.testing.assert_close(stds, torch.exp(0.5 * log_variances[[3, 1], :, :-1]) * scale)


def test_worlds_of_a_transformer_are_drawn_from_its_posterior() -> None:
    batch, generator = make_batch(), torch.Generator().manual_seed(0)
    means, stds = member_predictions(posterior(1.0), batch["observations"], batch["actions"], generator=generator)
    assert means.shape == stds.shape == (DRAWS, B, S)
    assert (means.std(0) > 0).all()
    assert torch.equal(stds[0], stds[1])  # what is noise is noise in all of them


@pytest.mark.parametrize("model", [linear_gaussians(members=1), small_transformer("none"), linear_world()])
def test_a_model_that_holds_one_world_possible_is_refused(model: WorldModel) -> None:
    with pytest.raises(UserError, match="take an ensemble of two elites or more, or a transformer trained with"):
        mobile_in(model)
