"""The Environment Transformer: causality, the ring cache, objectives, fidelity to the paper's form."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from walker import walker_dataset

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import LARGE_CACHE, Attention, rotate, rotation
from envtf_lit.world_models.finetuning import start_from
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.objectives import beta_nll, nll, paper_mse
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.transformer import EnvironmentTransformer

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
            uncached = model.predict(
                hidden[:, -1], model.normaliser.token(observations[-1], actions[:, t]), observations[-1]
            )
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
                token = model.normaliser.token(past[:, -1], done[:, -1])
                alone = model.predict(hidden[:, -1], token, past[:, -1]).observation
            torch.testing.assert_close(steps[t][row], alone[0], atol=1e-5, rtol=1e-4)
            past = torch.cat([past, alone[:, None]], 1)


def test_rollouts_that_share_a_window_equal_those_with_histories_of_their_own():
    """One pass over two windows of 12 steps, past the context of 6, against a pass for each rollout."""
    model, (observations, actions) = make_model(), sequences(2, 13)
    window, lengths = torch.tensor([1, 0, 0, 1, 0]), torch.tensor([12, 1, 5, 7, 12])
    with torch.no_grad():
        shared = model.init(observations[:, :12], actions[:, :11], lengths, window)
        alone = model.init(observations[window, :12], actions[window, :11], lengths)
        for t in range(8):
            shared, one = model.step(shared, actions[window, t])
            alone, other = model.step(alone, actions[window, t])
            torch.testing.assert_close(one.observation, other.observation)
        hidden, _ = model.encode(observations[1:, :7], actions[1:, :7], cached=False)
        fourth = model.init(observations, actions[:, :12], lengths[3:4], window[3:4])
        _, step = model.step(fourth, actions[1:, 6])
        token = model.normaliser.token(observations[1:, 6], actions[1:, 6])
        expected = model.predict(hidden[:, -1], token, observations[1:, 6])
    torch.testing.assert_close(step.observation, expected.observation)


@pytest.mark.parametrize("rows", [1, 100, 600])
def test_one_tokens_projection_is_that_of_whole_sequences(rows):
    """Whichever is turned, few rows or the weights of many."""
    attention = Attention(ModelOptions(width=64, heads=4))
    torch.nn.init.normal_(attention.qkv.bias)
    x = torch.randn(rows, 64, generator=torch.Generator().manual_seed(0))
    cos_sin = rotation(torch.tensor([7]), 16)
    expected = [part[:, :, 0] for part in attention.project(x[:, None], cos_sin)]
    torch.testing.assert_close(list(attention.project_token(x, cos_sin)), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_a_large_cache_is_read_token_by_token_to_the_same_effect(masked):
    """Both ways to attend, on either side of the size at which a CPU changes over."""
    attention = Attention(ModelOptions(width=64, heads=4))
    generator = torch.Generator().manual_seed(0)
    keys, values = torch.randn(2, 3, 1_600, 4, 16, generator=generator)
    q = torch.randn(1_600, 4, 16, generator=generator)
    mask = torch.rand(3, 1_600, 1, generator=generator) < 0.6 if masked else None
    if mask is not None:
        mask[2] = True
    assert keys.numel() > LARGE_CACHE > keys[:, :100].numel()
    with torch.no_grad():
        large = attention.recall(q, keys, values, mask)
        few = slice(0, 100)
        small = attention.recall(q[few], keys[:, few], values[:, few], None if mask is None else mask[:, few])
    torch.testing.assert_close(large[few], small)


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


def one_step(model: EnvironmentTransformer) -> Prediction:
    with torch.no_grad():
        state = model.init(torch.zeros(1, 1, S), torch.zeros(1, 0, A), torch.ones(1).long())
        return model.step(state, torch.zeros(1, A))[1]


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


def test_a_rollout_keeps_the_last_layer_it_drew():
    model, (observations, actions) = make_model(), sequences(40, 6)
    model.fit_epistemic([batch_of(observations, actions)], generator=torch.Generator().manual_seed(0))
    start = torch.zeros(2, 1, S), torch.zeros(2, 0, A), torch.ones(2).long()

    def trace(posterior: float) -> torch.Tensor:
        state = model.init(*start, posterior=posterior, generator=torch.Generator().manual_seed(0))
        steps = []
        for t in range(4):
            state, prediction = model.step(state, actions[:2, t])
            state = model.observe(state, observations[:2, t])  # the same inputs whatever was drawn
            steps.append(torch.cat([prediction.observation, prediction.reward[:, None]], -1) - prediction.mean)
        return torch.stack(steps)

    with torch.no_grad():
        once, twice = trace(1.0), trace(2.0)
        assert not trace(0.0).any()
        torch.testing.assert_close(twice, 2 * once, atol=1e-5, rtol=1e-4)
        assert not torch.allclose(once[:, 0], once[:, 1])
        state = model.init(*start, posterior=1.0, generator=torch.Generator().manual_seed(0))
        _, first = model.step(model.gather(state, torch.tensor([1])), actions[1:2, 0])
        torch.testing.assert_close(first.observation - first.mean[:, :-1], once[0, 1:, :-1], atol=1e-5, rtol=1e-4)
    with pytest.raises(UserError, match="has no posterior to draw from"):
        make_model(epistemic="none").init(*start, posterior=1.0)


def batch_of(observations: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    B, T, _ = observations.shape
    return dict(
        observations=observations,
        actions=actions,
        next_observations=observations + 0.1,
        rewards=torch.ones(B, T),
        mask=torch.ones(B, T),
    )


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


# starting from another model

SMALL = dict(layers=2, heads=2, width=16, context=6)


def scaled(model: EnvironmentTransformer, seed: int) -> EnvironmentTransformer:
    """The same with a normaliser of its own."""
    generator = torch.Generator().manual_seed(seed)
    for name, buffer in model.normaliser.named_buffers():
        if name != "live":
            drawn = torch.rand(buffer.shape, generator=generator)
            buffer.copy_(0.5 + drawn if name.endswith("std") else drawn - 0.5)
    return model


@pytest.mark.parametrize("epistemic", ["laplace", "head"])
def test_a_model_that_starts_from_another_predicts_as_it_did_whatever_its_own_scale(epistemic):
    torch.manual_seed(0)
    base = scaled(EnvironmentTransformer(3, 2, **SMALL, epistemic=epistemic), 1)
    mine = scaled(EnvironmentTransformer(3, 2, **SMALL, epistemic=epistemic), 2)
    before = {name: buffer.clone() for name, buffer in mine.normaliser.named_buffers()}
    start_from(mine, base)
    assert all(torch.equal(buffer, before[name]) for name, buffer in mine.normaliser.named_buffers())
    observations, actions = torch.randn(4, 5, 3), torch.randn(4, 5, 2)
    outcomes, deviations = [], []
    for model in (base, mine):
        mean, log_variance, _ = model(observations, actions)
        outcomes.append(model.normaliser.outcome(observations, mean))
        deviations.append((0.5 * log_variance).exp() * model.normaliser.target_std)
    torch.testing.assert_close(outcomes[1], outcomes[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(deviations[1], deviations[0], rtol=2e-2, atol=0)  # up to the soft bounds


@pytest.mark.parametrize(
    ("S", "A", "kept"), [(3, 2, {"embed", "head"}), (3, 4, {"head"}), (4, 2, set()), (4, 1, set())]
)
def test_the_blocks_are_kept_and_projections_of_other_dimensions_begin_anew(S, A, kept):
    torch.manual_seed(0)
    base, mine = EnvironmentTransformer(3, 2, **SMALL), EnvironmentTransformer(S, A, **SMALL)
    fresh = {name: value.clone() for name, value in mine.state_dict().items()}
    start_from(mine, base)
    theirs = base.state_dict()
    for name, value in mine.named_parameters():
        taken_over = name.split(".")[0] in {"blocks", "norm"} | kept
        assert torch.equal(value, theirs[name] if taken_over else fresh[name]), name


def test_what_the_weights_mean_cannot_change():
    base = EnvironmentTransformer(3, 2, **SMALL)
    with pytest.raises(UserError, match="target is delta there and absolute here"):
        start_from(EnvironmentTransformer(3, 2, **SMALL, target="absolute"), base)


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


@pytest.mark.slow
def test_fused_steps_equal_plain_ones(monkeypatch: pytest.MonkeyPatch):
    # what inductor makes of the graphs is its own business
    through_dynamo = partial(torch.compile, backend="eager")
    plain, fused = (make_model().requires_grad_(False) for _ in range(2))
    monkeypatch.setattr(torch, "compile", through_dynamo)
    fused.fuse()
    observations, actions = sequences(5, 4)
    lengths = torch.tensor([1, 2, 4, 4, 3])
    states = [model.init(observations, actions[:, :-1], lengths) for model in (plain, fused)]
    for step in range(9):  # past the context
        for number, model in enumerate((plain, fused)):
            torch.manual_seed(step)
            action = torch.randn(len(states[number].observation), A)
            states[number], _ = model.step(states[number], action, mode="sample")
            if step == 4:  # rollouts end, and fewer go on
                states[number] = model.gather(states[number], torch.tensor([0, 3]))
        torch.testing.assert_close(states[1].observation, states[0].observation)
