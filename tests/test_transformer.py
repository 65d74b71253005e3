"""The Environment Transformer: causality, objectives, uncertainty, fidelity to the paper's form."""

import math

import numpy as np
import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import rotate, rotation
from envtf_lit.world_models.objectives import beta_nll, nll, paper_mse
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.transformers import A, S, batch_of, make_model, one_step, sequences
from tests.walker import walker_dataset


def test_no_token_sees_the_future_or_beyond_the_window():
    model, (observations, actions) = make_model(layers=1), sequences(1, 12)
    observations.requires_grad_()
    mean, _, _ = model(observations, actions)
    for t in (0, 5, 11):
        (gradient,) = torch.autograd.grad(mean[0, t].sum(), observations, retain_graph=True)
        seen = gradient[0].abs().sum(-1) > 0
        expected = torch.tensor([t - 6 < i <= t for i in range(12)])
        assert torch.equal(seen, expected)


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
    turned = lambda x, position: rotate(x, rotation(torch.tensor([position]), 8))  # noqa: E731
    product = lambda i, j: (turned(q, i) * turned(k, j)).sum()  # noqa: E731
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


def test_epistemic_variance_comes_from_where_the_options_say():
    assert one_step(make_model(epistemic="none")).epistemic is None
    unfitted, head = one_step(make_model()), one_step(make_model(epistemic="head"))
    assert unfitted.epistemic is not None and unfitted.novelty is not None
    assert not unfitted.epistemic.any() and not unfitted.novelty.any()
    assert head.epistemic is not None and head.epistemic.all() and head.novelty is None


def test_paper_mse_needs_the_papers_head():
    with pytest.raises(UserError, match="epistemic is laplace: set it to head"):
        make_model(objective="paper_mse")


def test_an_epistemic_head_shares_the_likelihood_with_the_aleatoric_one():
    model, (observations, actions) = make_model(epistemic="head", objective="nll"), sequences(2, 6)
    batch = batch_of(observations, actions)
    mean, aleatoric, epistemic = model(observations, actions)
    target = model.normaliser.target(observations, batch["next_observations"], batch["rewards"])
    expected = nll(mean, (aleatoric.exp() + epistemic.exp()).log(), target).mean() / (S + 1)
    torch.testing.assert_close(model.loss(batch), expected)


def test_uncertainty_and_density_take_in_the_fitted_posterior():
    model, (observations, actions) = make_model(), sequences(40, 6)
    before, laplace = one_step(model), model.laplace
    assert laplace is not None
    model.fit_epistemic([batch_of(observations, actions)], generator=torch.Generator().manual_seed(0))
    after = one_step(model)
    assert after.epistemic is not None and after.novelty is not None
    assert torch.equal(after.aleatoric, before.aleatoric) and after.uncertainty > before.uncertainty
    ratio = model.normaliser.target_std[:-1] / model.normaliser.observation_std
    unit = torch.cat([ratio / model.normaliser.target_std[:-1], torch.zeros(1)])
    expected = ((after.aleatoric.square() + after.epistemic.square()) * unit.square()).sum(-1).div(S).sqrt()
    torch.testing.assert_close(after.uncertainty, expected)
    leverage = after.novelty * laplace.limit
    expected = laplace.variance(leverage) * model.normaliser.target_std.square()
    torch.testing.assert_close(after.epistemic.square(), expected)


def test_padding_does_not_change_the_loss():
    model, (observations, actions) = make_model(), sequences(2, 6)
    batch = batch_of(observations, actions)
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


def test_bounded_predictions_never_leave_the_range_of_the_data():
    data = walker_dataset()
    outcomes = np.column_stack([data.next_observations, data.rewards])
    margin = 0.1 * (outcomes.max(0) - outcomes.min(0))
    low, high = (torch.from_numpy(x) for x in (outcomes.min(0) - margin, outcomes.max(0) + margin))
    wild = {}
    for bounded in (False, True):
        torch.manual_seed(0)
        model = EnvironmentTransformer(11, 3, layers=1, heads=2, width=16, context=4, bounded=bounded).eval()
        model.normaliser.fit(data)
        model.head.bias.data.fill_(50.0)
        first, actions = torch.from_numpy(data.observations[:4])[:, None], torch.zeros(4, 30, 3)
        state, seen = model.init(first, actions[:, :0], torch.ones(4, dtype=torch.long)), []
        for t in range(30):
            mode = "sample" if t % 2 else "mean"
            state, prediction = model.step(state, actions[:, t], mode=mode)
            seen += [prediction.mean, torch.cat([prediction.observation, prediction.reward[:, None]], -1)]
        wild[bounded] = torch.stack(seen)
        assert ("normaliser.outcome_low" in model.state_dict()) is bounded
    assert (wild[False] > high + 1.0).any() and torch.isfinite(wild[True]).all()
    assert bool(((wild[True] >= low - 1e-5) & (wild[True] <= high + 1e-5)).all())


def test_without_dropout_the_loss_draws_nothing():
    observations, actions = sequences(2, 6)
    batch = dict(observations=observations, actions=actions, next_observations=observations)
    batch |= dict(rewards=torch.zeros(2, 6), mask=torch.ones(2, 6))
    model, before = make_model().train(), torch.get_rng_state()
    model.loss(batch)
    assert torch.equal(torch.get_rng_state(), before)
