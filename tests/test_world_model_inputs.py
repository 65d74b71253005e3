"""What world models and planners may be given: arrays, lists and other precisions as well as tensors."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.planning.options import RandomShootingOptions
from envtf_lit.planning.shooting import RandomShooting
from tests.analytic import linear_world
from tests.test_ensemble import make_ensemble
from tests.transformers import A, S, make_model, sequences

MODELS = {"transformer": make_model, "ensemble": make_ensemble}
KINDS = {
    "double": lambda x: x.double(),
    "array": lambda x: x.numpy(),
    "double array": lambda x: x.double().numpy(),
    "list": lambda x: x.tolist(),
}


def predicted(model: Any, given: Any, lengths: Any) -> list[Tensor]:
    """What follows a history and two actions, after a look at what was really seen."""
    seen, done = sequences(3, 6)
    with torch.no_grad():
        state = model.init(given(seen[:, :4]), given(done[:, :3]), lengths)
        state, first = model.step(state, given(done[:, 3]))
        _, second = model.step(model.observe(state, given(seen[:, 4])), given(done[:, 4]))
    return [first.observation, first.reward, second.observation, second.aleatoric]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", MODELS)
def test_a_world_model_takes_what_holds_the_same_numbers(name: str, kind: str) -> None:
    model = MODELS[name]()
    expected = predicted(model, lambda x: x, torch.tensor([4, 1, 3]))
    found = predicted(model, KINDS[kind], [4, 1, 3])
    assert all(torch.equal(one, two) and one.dtype == torch.float32 for one, two in zip(found, expected, strict=True))


@pytest.mark.parametrize("name", MODELS)
def test_a_state_does_not_change_with_the_array_that_it_was_made_of(name: str) -> None:
    model, seen = MODELS[name](), np.zeros((1, 1, S), np.float32)
    state = model.init(seen, np.zeros((1, 0, A)), [1])
    seen += 1
    assert float(model.current(state).abs().max()) == 0


@pytest.mark.parametrize("name", MODELS)
def test_a_world_model_says_what_does_not_fit(name: str) -> None:
    model, (seen, done) = MODELS[name](), sequences(2, 3)
    for given, words in (
        ((seen[0], done[0, :2], [3]), r"observations of shape \(any, any, 5\) here.*\(3, 5\): .*as \[x\]"),
        ((seen, done, [3, 3]), r"actions between them of shape \(2, 2, 2\) here, and was given \(2, 3, 2\)"),
        ((seen, done[:, :2], [3]), r"\(1,\) lengths for 2 rollouts"),
        ((seen, done[:, :2], [0, 4]), r"histories of \[0, 4\] observations, and its windows have 3"),
        (([[[1.0] * S], [[2.0]]], done[:, :0], [1, 1]), "observations that make no array of numbers"),
        ((seen, done[:, :2], [3, [1, 2]]), r"lengths \[3, \[1, 2\]\]: give whole numbers"),
        ((seen, done[:, :2], None), "lengths None: give whole numbers"),
        ((seen, done[:, :2], [2.7, 1.0]), r"lengths \[2.7, 1.0\]: give whole numbers"),
        ((seen, done[:, :2], [3, 3], [0, 2]), r"windows \[0, 2\] of 2: they are numbered from 0"),
        ((seen[:, :0], done[:, :0], [1, 1]), "histories of no observations: each ends with the present one"),
    ):
        with pytest.raises(UserError, match=words):
            model.init(*given)
    state = model.init(seen, done[:, :2], [3, 3])
    with pytest.raises(UserError, match=r"actions of shape \(2, 2\) here, and was given \(2,\): .*as \[x\]"):
        model.step(state, [0.0, 0.0])
    with pytest.raises(UserError, match=r"observations of shape \(2, 5\) here, and was given \(2, 4\): give as many"):
        model.observe(state, seen[:, 2, :4])


def test_a_planner_acts_on_what_an_environment_shows_and_gives_back_in_kind() -> None:
    def planned(observation: Any) -> Any:
        return RandomShooting(linear_world(), [-1.0], [1.0], RandomShootingOptions(samples=4)).act(observation)

    seen = torch.tensor([[0.5, -1.0, 2.0]])
    expected = planned(seen)
    assert torch.equal(planned(seen.double()), expected.double())
    for given in (seen.double().numpy(), seen.tolist()):
        found = planned(given)
        assert isinstance(found, np.ndarray) and found.dtype == np.float32
        assert np.array_equal(found, expected.numpy())
    alone = planned(seen[0].numpy())
    assert isinstance(alone, np.ndarray) and np.array_equal(alone, expected[0].numpy())
