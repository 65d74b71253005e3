"""One door for every source, and the card beside the data."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envtf_lit.data.cards import counted_episodes, dataset_card
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.data.sources.minari import write_minari
from envtf_lit.errors import UserError
from envtf_lit.pipeline.download import make_dataset
from envtf_lit.robots.tasks import get_task
from envtf_lit.zoo.collect import collect

TASK = get_task("hopper-medium-replay")
ZOO = DownloadOptions(source="zoo", transitions=300)


@pytest.fixture(scope="module")
def zoo() -> tuple[OfflineDataset, dict[str, Any]]:
    return make_dataset(TASK, ZOO, seed=7, workers=1)


@pytest.fixture(scope="module")
def dataset(zoo: tuple[OfflineDataset, dict[str, Any]]) -> OfflineDataset:
    return zoo[0]


def test_zoo_is_what_collect_gives(dataset: OfflineDataset):
    same = collect(TASK, 300, seed=7, workers=1, progress=False)
    assert np.array_equal(dataset.observations, same.observations)
    assert np.array_equal(dataset.actions, same.actions)


def test_file(dataset: OfflineDataset, tmp_path: Path):
    path = tmp_path / "log.npz"
    save_dataset(dataset, path)
    read, origin = make_dataset(TASK, DownloadOptions(source="file", path=str(path)), seed=0, workers=1)
    assert np.array_equal(read.rewards, dataset.rewards)
    assert origin == {
        "path": str(path), "bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()
    }  # fmt: skip
    assert "policies" not in dataset_card(read, "file", origin)


@pytest.mark.usefixtures("minari_root")
def test_minari(dataset: OfflineDataset):
    write_minari(dataset, "ours/hopper-v0")
    options = DownloadOptions(source="minari", minari_id="ours/hopper-v0")
    read, origin = make_dataset(TASK, options, seed=0, workers=1)
    assert np.array_equal(read.next_observations, dataset.next_observations)
    card = dataset_card(read, "minari", origin)
    assert json.loads(json.dumps(card, allow_nan=False)) == card
    assert (card["minari_id"], card["collected_in"], card["env_id"]) == ("ours/hopper-v0", "Hopper-v5", "Hopper-v5")
    assert "scores" not in card and "no D4RL-normalised score" in card["note"]
    assert card["returns"]["max"] == dataset.episode_returns.max()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (DownloadOptions(source="file"), "download.path is null"),
        (DownloadOptions(source="file", path="nowhere.h5"), "nowhere.h5 is not a file"),
        (DownloadOptions(source="zoo", path="some.h5"), "has no use for it"),
    ],
)
def test_options_that_contradict_each_other(options: DownloadOptions, message: str):
    with pytest.raises(UserError, match=message):
        make_dataset(TASK, options, seed=0, workers=1)


def test_card_of_the_zoo(zoo: tuple[OfflineDataset, dict[str, Any]]):
    dataset, card = zoo[0], dataset_card(zoo[0], "zoo", zoo[1])
    assert json.loads(json.dumps(card, allow_nan=False)) == card
    assert card["transitions"] == sum(policy["transitions"] for policy in card["policies"]) == 300
    assert card["episodes"] == card["terminated"] + card["truncated"] == len(dataset.episode_starts)
    assert card["returns"]["max"] == dataset.episode_returns.max()
    counted = dataset.episode_returns[counted_episodes(dataset, "zoo")]
    assert card["scores"]["mean"] == pytest.approx(100 * (counted.mean() + 20.272305) / 3254.572305)
    assert card["seed"] == 7
    assert card["env_id"] == "Hopper-v5"
    assert set(card["versions"]) == {"gymnasium", "mujoco", "numpy", "torch", "python"}
    assert "not D4RL's files" in card["note"]
