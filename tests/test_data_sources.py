"""One door for every source, and the card beside the data."""

import json
from pathlib import Path

import numpy as np
import pytest

from envtf_lit.data.behaviour import collect
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.formats import save_dataset
from envtf_lit.data.sources import dataset_card, make_dataset
from envtf_lit.errors import UserError
from envtf_lit.params import DownloadOptions
from envtf_lit.tasks import get_task

TASK = get_task("hopper-medium-replay")
ZOO = DownloadOptions(source="zoo", transitions=300)


@pytest.fixture(scope="module")
def dataset() -> OfflineDataset:
    return make_dataset(TASK, ZOO, seed=0, workers=1)


def test_zoo_is_what_collect_gives(dataset: OfflineDataset):
    same = collect(TASK, 300, seed=0, workers=1, progress=False)
    assert np.array_equal(dataset.observations, same.observations)
    assert np.array_equal(dataset.actions, same.actions)


def test_file(dataset: OfflineDataset, tmp_path: Path):
    save_dataset(dataset, tmp_path / "log.npz")
    options = DownloadOptions(source="file", path=str(tmp_path / "log.npz"))
    read = make_dataset(TASK, options, seed=0, workers=1)
    assert np.array_equal(read.rewards, dataset.rewards)
    card = dataset_card(read, options, 0)
    assert card["path"] == options.path
    assert "policies" not in card


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (DownloadOptions(source="file"), "download.path is empty"),
        (DownloadOptions(source="file", path="nowhere.h5"), "nowhere.h5 is not a file"),
        (DownloadOptions(source="zoo", path="some.h5"), "which reads no file"),
    ],
)
def test_options_that_contradict_each_other(options: DownloadOptions, message: str):
    with pytest.raises(UserError, match=message):
        make_dataset(TASK, options, seed=0, workers=1)


def test_card_of_the_zoo(dataset: OfflineDataset):
    card = dataset_card(dataset, ZOO, 7)
    assert json.loads(json.dumps(card, allow_nan=False)) == card
    assert card["transitions"] == sum(policy["transitions"] for policy in card["policies"]) == 300
    assert card["episodes"] == card["terminated"] + card["truncated"] == len(dataset.episode_starts)
    assert card["returns"]["max"] == dataset.episode_returns.max()
    assert card["scores"]["mean"] == pytest.approx(100 * (dataset.episode_returns.mean() + 20.272305) / 3254.572305)
    assert card["seed"] == 7
    assert card["env_id"] == "Hopper-v5"
    assert set(card["versions"]) == {"gymnasium", "mujoco", "numpy", "torch", "python"}
    assert "not D4RL's files" in card["note"]
