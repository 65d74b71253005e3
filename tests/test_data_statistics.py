"""Statistics of a dataset: blocks make no difference, nor does the unit of any column."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walker import walker_dataset

from envtf_lit.data.columns import column_blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import ReturnWeights
from envtf_lit.data.statistics import Moments
from envtf_lit.evaluation.offline import action_error
from envtf_lit.world_models import termination_head
from envtf_lit.world_models.forecast import Scale, nmse, whole_episodes
from envtf_lit.world_models.normaliser import Normaliser
from envtf_lit.world_models.termination_head import TerminationHead

UNITS = [1e-9, 1e-5, 2.0**-20, 1.0, 2.0**20, 1e9]


def log() -> OfflineDataset:
    """The walker's, in which dimension 3 is constant and dimension 4 constantly zero."""
    data = walker_dataset()
    columns = {name: np.array(getattr(data, name)) for name in ("observations", "next_observations")}
    for column in columns.values():
        column[:, 3], column[:, 4] = 0.7, 0.0
    return replace(data, **columns)


def in_units(data: OfflineDataset, unit: float) -> OfflineDataset:
    """The same log with every quantity in another unit."""
    columns = ("observations", "actions", "rewards", "next_observations", "action_low", "action_high")
    return replace(data, **{name: getattr(data, name) * np.float32(unit) for name in columns})


def rows(data: OfflineDataset) -> tuple[torch.Tensor, ...]:
    names = ("observations", "actions", "next_observations", "rewards")
    return tuple(torch.as_tensor(getattr(data, name)) for name in names)


def test_moments_of_blocks_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, (1000, 4)).astype(np.float32)
    whole = torch.std_mean(torch.as_tensor(values).double(), dim=0, correction=0)
    assert torch.equal(Moments.of([torch.as_tensor(values)]).std, whole[0])
    monkeypatch.setattr("envtf_lit.data.columns.BLOCK_BYTES", 16 * 37)
    found = Moments.of(torch.as_tensor(values[block]) for block in column_blocks(values))
    torch.testing.assert_close((found.std, found.mean), whole, rtol=1e-12, atol=0)
    assert found.low.tolist() == values.min(0).tolist() and found.high.tolist() == values.max(0).tolist()


def test_columns_against_numpy() -> None:
    data = log()
    changes = np.subtract(data.next_observations, data.observations)
    for found, values in (
        (data.statistics.observations, data.observations),
        (data.statistics.actions, data.actions),
        (data.statistics.next_observations, data.next_observations),
        (data.statistics.rewards, data.rewards[:, None]),
        (data.statistics.changes[:-1], changes),
        (data.statistics.outcomes[-1:], data.rewards[:, None]),
    ):
        values = np.asarray(values, np.float64)
        np.testing.assert_allclose(found.mean, values.mean(0), rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(found.std, values.std(0), rtol=1e-9, atol=1e-14)


def test_a_dimension_is_constant_beside_its_own_magnitude() -> None:
    n = 1000
    steps = torch.arange(n).double()
    columns = {
        "zero": 0 * steps,
        "constant": 0 * steps + 1e-8,
        "small": 1e-12 * steps,
        "clock": 1.7e9 + steps % 2 * 128,  # what float32 leaves of seconds
        "offset": 1e4 + steps % 2,
        "rare": (steps == 5) * 1e-9,
        "denormal": 1e-42 * (steps % 2),
    }
    found = Moments.of([torch.stack([*columns.values()], 1).float()])
    assert dict(zip(columns, found.live.tolist(), strict=True)) == {
        "zero": False, "constant": False, "small": True, "clock": False, "offset": True, "rare": True, "denormal": False
    }  # fmt: skip
    assert (found.scale > 0).all() and found.scale[0] == 1
    assert found.scale[1] == pytest.approx(1e-8)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("delta", [True, False])
def test_the_world_models_inputs_and_targets_have_no_unit(unit: float, delta: bool) -> None:
    def z_scores(data: OfflineDataset) -> tuple[torch.Tensor, ...]:
        observation, action, following, reward = rows(data)
        normaliser = Normaliser(data.observation_dim, data.action_dim, delta=delta, bounded=True)
        normaliser.fit(data)
        target = normaliser.target(observation, following, reward)
        uncertainty = normaliser.uncertainty(torch.ones_like(target))
        outcome = normaliser.outcome(observation, target) / data.action_high[0]
        return normaliser.token(observation, action), target, uncertainty, outcome, normaliser.live

    expected, found = z_scores(log()), z_scores(in_units(log(), unit))
    if np.log2(unit).is_integer():
        assert all(torch.equal(one, two) for one, two in zip(expected, found, strict=True))
    for one, two in zip(expected, found, strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-3)  # differences of float32 round
    assert found[-1].tolist() == [index not in (3, 4) for index in range(11)]


@pytest.mark.parametrize("unit", UNITS)
def test_the_agents_and_the_termination_heads_inputs_have_no_unit(unit: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(termination_head, "UPDATES", 1)

    def z_scores(data: OfflineDataset) -> tuple[torch.Tensor, ...]:
        mean, std = data.observation_scale()
        head = TerminationHead(data.observation_dim)
        head.fit(data, seed=0)
        return (rows(data)[0] - mean) / std, (rows(data)[2] - head.mean) / head.std

    for one, two in zip(z_scores(log()), z_scores(in_units(log(), unit)), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-4)


class Echo:
    def act(
        self, observation: torch.Tensor, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        return 2 * observation[:, :3]


@pytest.mark.parametrize("unit", UNITS)
def test_errors_and_weights_have_no_unit(unit: float) -> None:
    def errors(data: OfflineDataset) -> tuple[torch.Tensor, ...]:
        scale, episodes = Scale.of(data), whole_episodes(data, 4, seed=0)
        error = nmse(episodes.targets.roll(1, 0), episodes, scale)
        policy_error = torch.tensor(action_error(Echo(), episodes, data))
        return error, policy_error, scale.live, ReturnWeights.of(data, 0.5)(data)

    for one, two in zip(errors(log()), errors(in_units(log(), unit)), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def test_a_log_of_equal_returns_is_drawn_from_evenly() -> None:
    data = replace(log(), rewards=np.ones(len(log()), np.float32))
    assert len(ReturnWeights.of(data, 0.5)(data).unique()) == 1
