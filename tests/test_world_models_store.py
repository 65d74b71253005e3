"""A world model from a folder, and whether it is one of the log that it shall imagine from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.store import load_world_model, save_world_model
from tests.walker import walker_dataset

LOG = walker_dataset()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A model with the scales of a log of Hopper's dimensions."""
    model = EnsembleDynamics(LOG.observation_dim, LOG.action_dim, members=2, elites=2, hidden=(8, 8))
    model.normaliser.fit(LOG)
    save_world_model(tmp_path / "model", model)
    return tmp_path / "model"


def moved(shift: float, scale: float, dimension: int = 3) -> OfflineDataset:
    """The log with one dimension of its states so many of its deviations away, or that much wider."""
    recorded = np.asarray(LOG.observations)[:, dimension]
    mean, std = recorded.mean(), recorded.std()
    columns = {}
    for name in ("observations", "next_observations"):
        columns[name] = np.array(getattr(LOG, name))
        columns[name][:, dimension] = mean + shift * std + scale * (columns[name][:, dimension] - mean)
    return replace(LOG, **columns)


@pytest.mark.parametrize("log", [LOG, moved(5.0, 1.0), moved(0.0, 5.0), moved(0.0, 0.01)])
def test_a_model_may_imagine_from_a_log_whose_states_it_can_see(folder: Path, log: OfflineDataset) -> None:
    assert load_world_model(folder, dataset=log).observation_dim == 11


@pytest.mark.parametrize("log", [moved(20.0, 1.0), moved(-20.0, 1.0), moved(0.0, 20.0)])
def test_a_model_of_other_states_is_refused(folder: Path, log: OfflineDataset) -> None:
    load_world_model(folder)  # as such it is sound
    with pytest.raises(UserError, match=r"model learned from other states: dimension 3 was .* ± .*, and is .* ± "):
        load_world_model(folder, dataset=log)


def test_a_model_of_other_dimensions_is_refused(folder: Path) -> None:
    narrow = {name: getattr(LOG, name)[:, :8] for name in ("observations", "next_observations")}
    with pytest.raises(UserError, match="of 11 observations and 3 actions, and the dataset has 8 and 3: train one"):
        load_world_model(folder, dataset=replace(LOG, **narrow))
