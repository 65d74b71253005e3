"""RAMBO by hand: the score gradient, the mixture of joint densities, an unkind model, and models that cannot learn."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from envtf_lit.agents.rambo import RAMBO, adversarial_loss, context_of
from envtf_lit.data.loaders import Windows
from envtf_lit.errors import UserError
from envtf_lit.world_models.interface import WorldModel
from tests.analytic import linear_data, linear_world
from tests.hand_driven import S, hand_driven, make_batch
from tests.worlds import StateCritics, linear_gaussians, small_transformer, source_in


def rambo_in(model: WorldModel, **options: Any) -> Any:
    agent = hand_driven(RAMBO, source=source_in(model), batch_size=32, **options)
    agent.windows = Windows(linear_data((30, 40)), context_of(agent.model))
    return agent


def test_the_score_gradient_of_a_linear_gaussian_model_is_the_analytic_one() -> None:
    """`d log N(y; W x, v) / dW = (y - W x) x / v`, each row times its advantage."""
    agent = rambo_in(linear_gaussians(members=1))
    (observation, action), prediction, stands = agent.imagined_step(0)
    advantage = agent.advantage(observation, action, prediction, stands)
    weight = agent.model.weights[0]
    (found,) = torch.autograd.grad(adversarial_loss(prediction.log_prob, advantage, stands), weight)
    normaliser = agent.model.normaliser
    x = normaliser.token(observation, action)
    mean, log_variance = (output[0].detach() for output in agent.model(x))
    y = normaliser.target(observation, prediction.observation, prediction.reward).detach()
    slope = advantage[:, None] * (y - mean) / log_variance.exp()  # (B, S + 1)
    torch.testing.assert_close(found[0, :, : S + 1], x.T @ slope / len(x), rtol=1e-3, atol=1e-5)
    assert found.abs().max() > 1e-3  # (B,) x (B, 1) would leave nothing: the advantages' mean is zero


def test_the_density_is_the_mixture_of_the_members_joint_densities() -> None:
    agent = rambo_in(linear_gaussians(members=3))
    (observation, action), prediction, _ = agent.imagined_step(1)
    normaliser = agent.model.normaliser
    mean, log_variance = agent.model(normaliser.token(observation, action))
    y = normaliser.target(observation, prediction.observation, prediction.reward)
    joint = torch.distributions.Normal(mean, torch.exp(0.5 * log_variance)).log_prob(y).sum(-1)
    expected = joint.logsumexp(0) - math.log(3) - normaliser.target_std.log().sum()
    torch.testing.assert_close(prediction.log_prob, expected, rtol=1e-4, atol=1e-4)


def test_shapes_that_would_cancel_the_gradient_are_no_loss() -> None:
    rows, stands = torch.randn(5), torch.ones(5, dtype=torch.bool)
    adversarial_loss(rows, rows, stands)
    with pytest.raises(AssertionError):
        adversarial_loss(rows, rows[:, None], stands)


def test_the_advantage_is_that_of_what_was_imagined_over_what_was_expected() -> None:
    agent = rambo_in(linear_gaussians(), discount=0.9)
    agent.critics = StateCritics()
    agent.source.imagination.terminated = lambda states: states[:, 1] > 0
    (observation, action), prediction, _ = agent.imagined_step(0)
    stands = torch.arange(32) < 20
    value = prediction.reward + 0.9 * (prediction.observation[:, 1] <= 0) * prediction.observation[:, 0]
    plain = (value - observation[:, 0])[stands]
    expected = (plain - plain.mean()) / plain.std(correction=0)
    found = agent.advantage(observation, action, prediction, stands)
    torch.testing.assert_close(found[stands], expected.detach(), rtol=1e-4, atol=1e-5)


class NoCritics(nn.Module):
    """Q = 0: the advantage is that of the reward."""

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return torch.zeros(2, len(observation))


@pytest.mark.parametrize(("weight", "falls"), [(30.0, True), (0.0, False)])
def test_an_adversarial_model_promises_less(weight: float, falls: bool) -> None:
    agent, batch = rambo_in(linear_gaussians(), adversarial_weight=weight, model_learning_rate=0.01), make_batch()
    agent.critics = NoCritics()
    pair = batch["observations"], batch["actions"]

    def promised() -> float:
        token = agent.model.normaliser.token(*pair)
        return float(agent.model(token)[0][..., -1].mean().detach())

    for _ in range(60):  # the fit to the log first
        agent.descend("model", agent.model.loss(agent.windows[torch.arange(32)]))
    before = promised()
    for k in range(40):
        agent.descend("model", agent.model_loss(k % 2)[0])
    assert (promised() < before - 0.2) is falls


def test_the_model_has_its_round_at_the_end_of_each_stretch_and_the_given_one_stays_as_it_is() -> None:
    given = linear_gaussians()
    kept = {name: x.clone() for name, x in given.state_dict().items()}
    agent = rambo_in(given, adversarial_every=3, adversarial_updates=2)
    assert agent.source.imagination.model is agent.model and agent.model is not given
    parts = []
    for _ in range(6):
        for part, loss, _ in agent.losses(make_batch()):
            agent.descend(part, loss)
            parts.append(part)
        agent.update_index += 1
    sac = ["critics", "actor", "temperature"]
    assert parts == (2 * sac + ["model", "model"] + sac) * 2
    assert all(torch.equal(x, kept[name]) for name, x in given.state_dict().items())
    assert not torch.equal(agent.model.weights[0], given.weights[0])


def test_a_transformer_learns_too() -> None:
    agent = rambo_in(small_transformer(), adversarial_weight=1.0)
    before = agent.model.head.weight.clone()
    for depth in (0, 1):
        loss, logs = agent.model_loss(depth)
        agent.descend("model", loss)
        assert logs["adversarial_loss"].isfinite()
    assert not torch.equal(agent.model.head.weight, before)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_model_whose_density_has_no_gradient_is_refused(compiled: bool) -> None:
    model: Any = linear_gaussians() if compiled else linear_world()
    if compiled:
        model.step = model.step  # as `fuse` does: a method of the original
    with pytest.raises(UserError, match="take an ensemble or a transformer, and set compile to"):
        hand_driven(RAMBO, source=source_in(model))
