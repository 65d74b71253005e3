"""The Environment Transformer: causality, the ring cache, objectives, fidelity to the paper's form."""

import math

import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.params import ModelOptions
from envtf_lit.world_models.objectives import beta_nll, nll, paper_mse
from envtf_lit.world_models.transformer import EnvironmentTransformer, rotate

S, A = 5, 2


def make_model(**options) -> EnvironmentTransformer:
    torch.manual_seed(0)
    model = EnvironmentTransformer(S, A, **(dict(layers=2, heads=2, width=16, context=6) | options)).eval()
    for parameter in model.parameters():  # away from the near-zero initialisation, so that attention matters
        parameter.data.add_(0.3 * torch.randn_like(parameter))
    model.normaliser.target_std.copy_(torch.linspace(0.5, 2.0, S + 1))
    model.normaliser.observation_mean.copy_(torch.linspace(-1.0, 1.0, S))
    return model


def sequences(batch: int, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(batch, length, S, generator=generator), torch.randn(batch, length, A, generator=generator)


def test_no_token_sees_the_future_or_beyond_the_window():
    model, (observations, actions) = make_model(layers=1), sequences(1, 12)
    observations.requires_grad_()
    mean, _, _ = model(observations, actions)
    for t in (0, 5, 11):
        (gradient,) = torch.autograd.grad(mean[0, t].sum(), observations, retain_graph=True)
        seen = gradient[0].abs().sum(-1) > 0
        expected = torch.tensor([t - 6 < i <= t for i in range(12)])
        assert torch.equal(seen, expected)


@pytest.mark.parametrize("mode", ["delta", "absolute"])
def test_cached_generation_equals_the_uncached_pass_past_the_context(mode):
    model = make_model(target=mode)
    _, actions = sequences(3, 20)
    state = model.init(torch.randn(3, 1, S), actions[:, :0], torch.ones(3, dtype=torch.long))
    observations = [model.current(state)]
    with torch.no_grad():
        for t in range(20):
            state, prediction = model.step(state, actions[:, t])
            hidden, _ = model.encode(torch.stack(observations, 1), actions[:, : t + 1], cached=False)
            uncached = model.predict(hidden[:, -1], observations[-1])
            torch.testing.assert_close(prediction.observation, uncached.observation, atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(prediction.aleatoric, uncached.aleatoric, atol=1e-5, rtol=1e-4)
            observations.append(prediction.observation)


def test_histories_of_different_length_equal_their_own_uncached_pass():
    model, (observations, actions) = make_model(), sequences(4, 10)
    lengths = torch.tensor([1, 4, 7, 9])
    with torch.no_grad():
        state = model.init(observations[:, :9], actions[:, :8], lengths)
        torch.testing.assert_close(model.current(state), observations[torch.arange(4), lengths - 1])
        steps = []
        for t in range(8):  # goes on past the context of 6
            state, prediction = model.step(state, actions[:, t])
            steps.append(prediction.observation)
    for row, length in enumerate(lengths.tolist()):
        past, done = observations[row : row + 1, :length], actions[row : row + 1, : length - 1]
        for t in range(8):
            done = torch.cat([done, actions[row : row + 1, t : t + 1]], 1)
            with torch.no_grad():
                hidden, _ = model.encode(past, done, cached=False)
                alone = model.predict(hidden[:, -1], past[:, -1]).observation
            torch.testing.assert_close(steps[t][row], alone[0], atol=1e-5, rtol=1e-4)
            past = torch.cat([past, alone[:, None]], 1)


def test_fork_and_gather_continue_each_row_on_its_own():
    model, (observations, actions) = make_model(), sequences(3, 6)
    lengths = torch.tensor([2, 4, 3])
    with torch.no_grad():
        start = lambda: model.init(observations[:, :4], actions[:, :3], lengths)  # noqa: E731
        _, expected = model.step(start(), actions[:, 4])
        forked = model.fork(start(), 2)
        _, both = model.step(forked, actions[:, 4].repeat_interleave(2, 0))
        picked = model.gather(start(), torch.tensor([2, 0]))
        _, some = model.step(picked, actions[[2, 0], 4])
    torch.testing.assert_close(both.observation, expected.observation.repeat_interleave(2, 0))
    torch.testing.assert_close(some.observation, expected.observation[[2, 0]])


def test_gradients_flow_through_an_imagined_rollout():
    model, (_, actions) = make_model(), sequences(2, 4)
    actions.requires_grad_()
    state = model.init(torch.randn(2, 1, S), actions[:, :0], torch.ones(2, dtype=torch.long))
    total = torch.zeros(())
    for t in range(4):
        state, prediction = model.step(state, actions[:, t])
        total = total + prediction.reward.sum()
    total.backward()
    assert (actions.grad.abs().sum(-1) > 0).all()  # pyright: ignore[reportOptionalMemberAccess]


def test_sampling_is_seeded_and_has_the_predicted_moments():
    model = make_model()
    state = lambda: model.init(torch.zeros(20_000, 1, S), torch.zeros(20_000, 0, A), torch.ones(20_000).long())  # noqa: E731
    action = torch.zeros(20_000, A)
    draw = lambda seed: model.step(state(), action, mode="sample", generator=torch.Generator().manual_seed(seed))[1]  # noqa: E731
    with torch.no_grad():
        first, again, other = draw(0), draw(0), draw(1)
    assert torch.equal(first.observation, again.observation) and not torch.equal(first.observation, other.observation)
    torch.testing.assert_close(first.observation.std(0), first.aleatoric[0, :-1], rtol=0.03, atol=0)
    outcome = torch.cat([first.observation, first.reward[:, None]], -1)
    expected = torch.distributions.Normal(first.mean, first.aleatoric).log_prob(outcome).sum(-1)
    torch.testing.assert_close(first.log_prob, expected, rtol=1e-4, atol=1e-3)


def test_rotary_products_depend_on_the_distance_alone():
    q, k = torch.randn(1, 8), torch.randn(1, 8)
    product = lambda i, j: (rotate(q, torch.tensor([i])) * rotate(k, torch.tensor([j]))).sum()  # noqa: E731
    torch.testing.assert_close(product(3, 1), product(103, 101), rtol=1e-4, atol=1e-4)


def test_objectives_against_hand_computed_cases():
    mean, log_variance, target = torch.tensor([[1.0]]), torch.tensor([[math.log(4.0)]]), torch.tensor([[3.0]])
    assert nll(mean, log_variance, target).item() == pytest.approx(0.5 * (1.0 + math.log(4.0) + math.log(2 * math.pi)))
    assert beta_nll(mean, log_variance, target).item() == pytest.approx(2.0 * 0.5 * (1.0 + math.log(4.0)))


def test_paper_mse_has_the_expectation_that_collapses_its_variances():
    size = (200_000, 1)
    mean, target = torch.zeros(size), torch.full(size, 2.0)
    aleatoric, epistemic = torch.full(size, math.log(0.5)), torch.full(size, math.log(0.25))
    loss = paper_mse(mean, aleatoric, epistemic, target, generator=torch.Generator().manual_seed(0)).mean()
    assert loss.item() == pytest.approx(4.0 + 0.5 + 0.25, rel=0.02)


def test_only_the_papers_objective_claims_epistemic_uncertainty():
    step = lambda model: model.step(  # noqa: E731
        model.init(torch.zeros(1, 1, S), torch.zeros(1, 0, A), torch.ones(1).long()), torch.zeros(1, A)
    )[1]
    assert step(make_model()).epistemic is None
    assert step(make_model(objective="paper_mse")).epistemic is not None


def test_padding_does_not_change_the_loss():
    model, (observations, actions) = make_model(), sequences(2, 6)
    batch = dict(
        observations=observations,
        actions=actions,
        next_observations=observations + 0.1,
        rewards=torch.ones(2, 6),
        mask=torch.ones(2, 6),
    )
    batch["mask"][1, 3:] = 0.0
    expected = model.loss(batch)
    batch["observations"] = observations.clone()
    batch["observations"][1, 3:] = 100.0
    torch.testing.assert_close(model.loss(batch), expected)


def test_heads_must_divide_the_width():
    with pytest.raises(UserError, match="width 20 does not split into 8 heads"):
        EnvironmentTransformer(S, A, width=20, heads=8)


def test_default_options_are_the_small_preset():
    assert EnvironmentTransformer(S, A).options == ModelOptions()
