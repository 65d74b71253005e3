"""Files: round trips, D4RL's variants, and what stays on a full disk."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from logs import assert_equal, columns, write

from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from tests.full_disk import full_disk


@pytest.fixture(params=[".h5", ".npz"])
def ending(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.mark.parametrize("task", [None, "hopper-medium-replay"])
def test_round_trip(tmp_path: Path, ending: str, task: str | None):
    dataset = load_dataset(write(tmp_path / f"in{ending}", columns()), task=task)
    path = tmp_path / f"out{ending}"
    save_dataset(dataset, path)
    assert_equal(load_dataset(path), dataset)
    assert dataset.task == task
    assert [file.name for file in sorted(tmp_path.iterdir())] == [f"in{ending}", f"out{ending}"]


def test_both_formats_hold_the_same(tmp_path: Path):
    dataset = load_dataset(write(tmp_path / "in.hdf5", columns()))
    for ending in (".hdf5", ".npz"):
        save_dataset(dataset, tmp_path / f"out{ending}")
    assert_equal(load_dataset(tmp_path / "out.hdf5"), load_dataset(tmp_path / "out.npz"))


def test_written_bytes_do_not_hold_the_time(tmp_path: Path):
    dataset = load_dataset(write(tmp_path / "in.h5", columns()))
    for name in ("first", "second"):
        for ending in (".h5", ".npz"):
            save_dataset(dataset, tmp_path / f"{name}{ending}")
        if name == "first":
            time.sleep(2.1)  # the resolution of a zip archive's dates is two seconds
    for ending in (".h5", ".npz"):
        assert (tmp_path / f"first{ending}").read_bytes() == (tmp_path / f"second{ending}").read_bytes()


def test_episodes_and_endings(tmp_path: Path, ending: str):
    dataset = load_dataset(write(tmp_path / f"in{ending}", columns()))
    assert dataset.episode_starts.tolist() == [0, 4, 7]
    assert np.flatnonzero(dataset.terminated).tolist() == [3]
    assert np.flatnonzero(dataset.truncated).tolist() == [6, 11]  # the log's end truncates the last episode


def test_a_lone_row_after_the_last_ending_is_an_episode(tmp_path: Path, ending: str):
    content = columns()
    content["timeouts"][10] = True
    assert load_dataset(write(tmp_path / f"in{ending}", content)).episode_starts.tolist() == [0, 4, 7, 11]


@pytest.mark.parametrize("name", ["episode_index", "episode", "episode_id", "episode_ids"])
def test_an_episode_index_in_place_of_flags(tmp_path: Path, ending: str, name: str):
    content = columns()
    del content["terminals"], content["timeouts"]
    content[name] = np.repeat([0, 1, 2], [4, 3, 5])
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    assert dataset.episode_starts.tolist() == [0, 4, 7]


def test_other_names_types_and_groups(tmp_path: Path):
    content = columns()
    expected = load_dataset(write(tmp_path / "plain.h5", content))
    content["terminated"] = content.pop("terminals").astype(np.int64)
    content["truncated"] = content.pop("timeouts").astype(np.float64)
    content["observations"] = content["observations"].astype(np.float64)
    content["infos/qpos"] = np.full((3, 2), np.nan)
    content["metadata/algorithm"] = "SAC"
    assert_equal(load_dataset(write(tmp_path / "other.h5", content)), expected)


def test_integer_columns_become_float32(tmp_path: Path, ending: str):
    content = columns()
    content["rewards"] = np.arange(12)
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    assert dataset.rewards.dtype == np.float32
    assert dataset.rewards.tolist() == list(range(12))


def test_without_next_observations_the_last_row_of_each_episode_goes(tmp_path: Path, ending: str):
    content = columns()
    del content["next_observations"]
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    kept = [0, 1, 2, 4, 5, 7, 8, 9, 10]
    assert np.array_equal(dataset.observations, content["observations"][kept])
    assert np.array_equal(dataset.next_observations, content["observations"][[row + 1 for row in kept]])
    assert dataset.episode_starts.tolist() == [0, 3, 5]
    assert not dataset.terminated.any()
    assert np.flatnonzero(dataset.truncated).tolist() == [2, 4, 8]


def test_actions_a_rounding_error_outside_are_clipped(tmp_path: Path, ending: str):
    content = columns()
    content["actions"][2, 1] = 1.000005
    assert np.max(load_dataset(write(tmp_path / f"in{ending}", content)).actions) == 1


def test_stored_action_limits_are_used(tmp_path: Path, ending: str):
    content = columns() | {"action_low": np.full(3, -2.0), "action_high": np.full(3, 3.0)}
    content["actions"][0, 0] = 2.5
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    assert dataset.action_low.tolist() == [-2] * 3
    assert dataset.action_high.tolist() == [3] * 3


PLACES = ["action_low", "action_space/low", "action_space_low", "metadata/action_low", "metadata/action_space/low"]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", [".npz", "array", "attribute"])
def test_action_limits_are_found_wherever_they_are(tmp_path: Path, kind: str, place: str):
    content, path = columns(), tmp_path / ("in.npz" if kind == ".npz" else "in.h5")
    content["actions"] *= np.float32(0.4)
    limits = {place: np.full(3, -0.5), place.replace("low", "high"): np.full(3, 0.5)}
    write(path, content | limits if kind == ".npz" else content)
    if kind != ".npz":
        with h5py.File(path, "r+") as file:
            for name, values in limits.items():
                group, _, leaf = name.rpartition("/")
                within = file.require_group(group or "/")
                (within.attrs if kind == "attribute" else within)[leaf] = values
    dataset = load_dataset(path)
    assert dataset.action_low.tolist() == [-0.5] * 3
    assert dataset.action_high.tolist() == [0.5] * 3


def test_limits_that_disagree_are_refused(tmp_path: Path, ending: str):
    content = columns() | {"action_space/low": -np.ones(3), "action_space/high": np.ones(3)}
    stated = {"action_low": -2 * np.ones(3), "action_high": np.ones(3)}
    with pytest.raises(UserError, match=r"'action_low' is \[-2. -2. -2.\] at 'action_low' and \[-1. -1. -1.\] at"):
        load_dataset(write(tmp_path / f"in{ending}", content | stated))


def test_a_split_is_stored(tmp_path: Path, ending: str):
    dataset = load_dataset(write(tmp_path / f"in{ending}", columns())).with_split(0.3, seed=0)
    save_dataset(dataset, tmp_path / f"out{ending}")
    assert_equal(load_dataset(tmp_path / f"out{ending}"), dataset)


def test_a_file_that_another_program_writes_is_no_damaged_one(tmp_path: Path):
    path = write(tmp_path / "in.h5", columns())
    hold = f"import h5py\nwith h5py.File({str(path)!r}, 'r+'):\n    print('ready', flush=True)\n    input()"
    pipes: dict[str, Any] = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with subprocess.Popen([sys.executable, "-c", hold], **pipes) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == "ready\n"
        with pytest.raises(UserError, match="is open for writing in another program: close it there"):
            load_dataset(path)
        writer.communicate("\n")
    load_dataset(path)


def test_missing_file_folder_and_ending(tmp_path: Path, ending: str):
    with pytest.raises(UserError, match="is not a file"):
        load_dataset(tmp_path / f"none{ending}")
    (tmp_path / f"folder{ending}").mkdir()
    with pytest.raises(UserError, match="is not a file"):
        load_dataset(tmp_path / f"folder{ending}")
    (tmp_path / "data.csv").write_text("1,2\n")
    with pytest.raises(UserError, match=r"ends in '.csv': name a dataset .h5, .hdf5 or .npz"):
        load_dataset(tmp_path / "data.csv")


def test_a_full_disk_leaves_the_old_file_whole(tmp_path: Path, ending: str):
    dataset = load_dataset(write(tmp_path / f"in{ending}", columns()))
    path = tmp_path / f"out{ending}"
    path.write_bytes(b"old")
    with full_disk(1_000), pytest.raises(UserError, match="No space left while writing"):
        save_dataset(dataset, path)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2


def test_large_columns_are_written_and_read_in_blocks(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch):
    content = columns() | {"observations": columns()["observations"].astype(np.float64)}
    whole = load_dataset(write(tmp_path / f"in{ending}", content))
    save_dataset(whole, tmp_path / f"whole{ending}")
    monkeypatch.setattr("envtf_lit.data.columns.BLOCK_BYTES", 100)
    parts = load_dataset(tmp_path / f"in{ending}")
    assert_equal(parts, whole)
    save_dataset(parts, tmp_path / f"parts{ending}")
    assert (tmp_path / f"parts{ending}").read_bytes() == (tmp_path / f"whole{ending}").read_bytes()
