"""The Environment Transformer step by step: what its ring cache gives is what a pass over the whole history gives."""

from functools import partial

import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import LARGE_CACHE, Attention, rotation
from envtf_lit.world_models.options import ModelOptions
from tests.transformers import A, S, batch_of, make_model, sequences


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
