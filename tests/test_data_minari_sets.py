"""Minari's own library reads what we write, and we read what it writes."""

import contextlib
import json
import shutil
from pathlib import Path

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs import dataset_of_chains
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from envtf_lit.data.dataset import COLUMNS
from envtf_lit.data.sources.minari import describe_minari, read_minari, write_minari
from envtf_lit.errors import UserError
from envtf_lit.robots.hidden_dynamics import HiddenDynamics

pytestmark = pytest.mark.usefixtures("minari_root")
PLAIN = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)


def write_raw(
    minari_root: Path, episodes: list[EpisodeBuffer], observations: gym.Space = PLAIN, actions: gym.Space = ACTIONS
):
    """A dataset written by Minari's library: `raw-v0`."""
    (minari_root / "raw-v0").mkdir(parents=True)
    storage = MinariStorage.new(minari_root / "raw-v0/data", observation_space=observations, action_space=actions)
    storage.update_metadata({"dataset_id": "raw-v0", "minari_version": minari.__version__})
    storage.update_episodes(episodes)


def episode(steps: int, *, terminated: bool = False, truncated: bool = False, start: float = 0.0) -> EpisodeBuffer:
    flags = np.arange(steps) == steps - 1
    return EpisodeBuffer(
        observations=[*(start + np.arange(2.0 * (steps + 1)).reshape(steps + 1, 2))],
        actions=[*np.ones((steps, 1), np.float32)],
        rewards=[1.0] * steps,
        terminations=list(flags & terminated),
        truncations=list(flags & truncated),
    )


# there and back


@pytest.mark.parametrize("dataset_id", ["plain-v0", "name/space/nested-v3"])
def test_what_is_written_reads_back_alike(dataset_id: str) -> None:
    dataset = dataset_of_chains()
    assert write_minari(dataset, dataset_id) == 0
    again = read_minari(dataset_id)
    for name in (*COLUMNS, "episode_starts", "action_low", "action_high"):
        assert np.array_equal(getattr(dataset, name), getattr(again, name)), name
    assert again.task is None


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")  # Gymnasium's advice to leave -v4
@pytest.mark.parametrize(
    ("task", "width", "env_id"),
    [
        ("ant-random", 27, "Ant-v5"),
        ("ant-random-v4", 27, "Ant-v4"),
        ("ant-random-105d", 105, "Ant-v5"),
        ("ant-random-hidden", 27, "Ant-v5"),
    ],
)
def test_minari_reads_it_and_recovers_the_environment(task: str, width: int, env_id: str) -> None:
    dataset = dataset_of_chains(task, width, 8)
    write_minari(dataset, "ours/ant-v0")
    theirs = minari.load_dataset("ours/ant-v0")
    assert (theirs.total_episodes, theirs.total_steps) == (3, 9)
    assert list(minari.list_local_datasets()) == ["ours/ant-v0"]
    assert [len(data.observations) for data in theirs] == [4, 3, 5]
    environment = theirs.recover_environment()
    assert environment.spec is not None and environment.spec.id == env_id
    assert environment.observation_space.shape == (width,)  # the robot's own options came along
    assert isinstance(environment, HiddenDynamics) == task.endswith("-hidden")
    environment.close()
    assert read_minari("ours/ant-v0").task == task


def test_a_set_without_an_environment_says_so() -> None:
    write_minari(dataset_of_chains(), "plain-v0")
    theirs = minari.load_dataset("plain-v0")
    assert "No environment is known" in theirs.storage.metadata["description"]
    with pytest.raises(ValueError, match="cannot be recovered"):
        theirs.recover_environment()


def test_episodes_are_split_where_a_next_observation_is_not_the_following_row() -> None:
    dataset = dataset_of_chains()
    np.asarray(dataset.next_observations)[6] += 1  # within the third episode, after its second step
    assert write_minari(dataset, "split-v0") == 1
    again = read_minari("split-v0")
    assert again.episode_starts.tolist() == [0, 3, 5, 7]
    assert again.truncated.tolist() == [False] * 4 + [True, False, True, False, True]
    for name in ("observations", "actions", "rewards", "next_observations", "terminated"):
        assert np.array_equal(getattr(dataset, name), getattr(again, name)), name


def test_a_folder_elsewhere(tmp_path: Path) -> None:
    write_minari(dataset_of_chains(), "plain-v0", root=tmp_path / "elsewhere")
    with pytest.raises(UserError, match="no Minari dataset plain-v0"):
        read_minari("plain-v0")
    for folder in (tmp_path / "elsewhere/plain-v0", tmp_path / "elsewhere/plain-v0/data"):
        assert len(read_minari(folder)) == 9


def test_nothing_half_written_stays(minari_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episodes", fail)
    with pytest.raises(UserError, match="No space left"):
        write_minari(dataset_of_chains(), "plain-v0")
    assert list(minari_root.rglob("*")) == []


def test_a_dataset_that_exists_is_left_alone() -> None:
    write_minari(dataset_of_chains(), "plain-v0")
    with pytest.raises(UserError, match="another name or version"):
        write_minari(dataset_of_chains(), "plain-v0")


# what Minari's library writes


def test_endings_come_from_the_flags_or_the_end_of_the_episode(minari_root: Path) -> None:
    write_raw(minari_root, [episode(3, terminated=True), episode(2, truncated=True), episode(2), episode(1, start=90)])
    dataset = read_minari("raw-v0")
    assert dataset.episode_starts.tolist() == [0, 3, 5, 7]
    assert np.flatnonzero(dataset.terminated).tolist() == [2]
    assert np.flatnonzero(dataset.truncated).tolist() == [4, 6, 7]
    assert dataset.next_observations[2].tolist() == [6.0, 7.0]  # the last observation, not the next episode's first
    assert dataset.action_high.tolist() == [2.0]


def test_facts_for_the_card(minari_root: Path) -> None:
    write_minari(dataset_of_chains("ant-random", 27, 8), "ours/ant-v0")
    facts = describe_minari("ours/ant-v0")
    assert json.loads(json.dumps(facts)) == facts
    assert (facts["minari_id"], facts["collected_in"], facts["total_steps"]) == ("ours/ant-v0", "Ant-v5", 9)
    assert facts["bytes"] == (minari_root / "ours/ant-v0/data/main_data.hdf5").stat().st_size
    assert len(facts["sha256"]) == 64


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (gym.spaces.Dict({"a": PLAIN}), ACTIONS, "observations in Dict"),
        (gym.spaces.Box(0, 255, (40, 40, 3), np.uint8), ACTIONS, "observations in Box"),
        (PLAIN, gym.spaces.Discrete(3), r"actions in Discrete\(3\)"),
        (PLAIN, PLAIN, "unbounded"),
    ],
)
def test_spaces_that_are_no_vectors(
    minari_root: Path, observations: gym.Space, actions: gym.Space, message: str
) -> None:
    write_raw(minari_root, [], observations, actions)
    with pytest.raises(UserError, match=message):
        read_minari("raw-v0")


# bad input


@pytest.mark.parametrize("dataset_id", ["no-version", "../up-v0", "sp ace-v0", ""])
def test_malformed_ids(dataset_id: str) -> None:
    with pytest.raises(UserError, match="not a Minari id"):
        write_minari(dataset_of_chains(), dataset_id)


def test_a_robot_of_another_size() -> None:
    write_minari(dataset_of_chains(), "plain-v0")
    with pytest.raises(UserError, match="4 observation and 2 action"):
        read_minari("plain-v0", task="hopper-medium")


def damage(data: Path, how: str) -> None:
    file, metadata = data / "main_data.hdf5", data / "metadata.json"
    content = json.loads(metadata.read_text())
    if how == "truncated":
        file.write_bytes(file.read_bytes()[:3000])
    elif how == "no data":
        file.unlink()
    elif how == "not JSON":
        metadata.write_text("{")
    elif how == "a list":
        metadata.write_text("[]")
    elif how == "other version":
        metadata.write_text(json.dumps(content | {"minari_version": "9.9.9"}))
    elif how == "no spaces":
        del content["observation_space"]
        metadata.write_text(json.dumps(content | {"env_spec": json.dumps({"id": "x", "entry_point": "evil:run"})}))
    else:
        with h5py.File(file, "a") as h5:
            group = h5["episode_1"]
            assert isinstance(group, h5py.Group)
            del group["rewards"]
            if how == "external link":
                group["rewards"] = h5py.ExternalLink("/etc/passwd", "/x")
            elif how == "absurd size":
                group.create_dataset("rewards", (10**14,), np.float32, chunks=(10**6,), compression="gzip")
            elif how == "short rewards":
                group["rewards"] = np.ones(1)
            elif how == "texts":
                group["rewards"] = ["a", "b"]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("truncated", "damaged"),
        ("no data", "damaged"),
        ("not JSON", "damaged"),
        ("a list", "damaged"),
        ("other version", "9.9.9"),
        ("no spaces", "does not say its spaces"),
        ("no rewards", "damaged"),
        ("external link", "under /episode_1/rewards what leads elsewhere"),
        ("absurd size", "fills the memory"),
        ("short rewards", "T steps need"),
        ("texts", "store plain numbers"),
    ],
)
def test_damaged_sets_are_refused_with_a_sentence(minari_root: Path, how: str, message: str) -> None:
    write_minari(dataset_of_chains(), "plain-v0")
    damage(minari_root / "plain-v0/data", how)
    with pytest.raises(UserError, match=message):
        read_minari("plain-v0")


ODD = st.one_of(
    st.none(),
    st.integers(),
    st.floats(),
    st.text(max_size=9),
    st.lists(st.integers(), max_size=2),
    st.sampled_from(
        ['{"type": "Box"}', '{"type": "Box", "shape": [9e9], "dtype": "f4", "low": 0, "high": 1}', "arrow"]
    ),
)


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_is_damaged_ends_in_a_dataset_or_a_sentence(tmp_path: Path, data: st.DataObject) -> None:
    folder = tmp_path / "minari/plain-v0/data"
    if not folder.exists():
        write_minari(dataset_of_chains("ant-random", 27, 8), "plain-v0")
        for name in ("main_data.hdf5", "metadata.json"):
            shutil.copy(folder / name, tmp_path / name)
    content = bytearray((tmp_path / "main_data.hdf5").read_bytes())
    metadata = json.loads((tmp_path / "metadata.json").read_text())
    if data.draw(st.booleans()):
        for place, byte in data.draw(st.lists(st.tuples(st.integers(0, len(content) - 1), st.integers(0, 255)))):
            content[place] = byte
        del content[data.draw(st.integers(len(content) // 2, len(content))) :]
    else:
        metadata[data.draw(st.sampled_from(sorted(metadata)))] = data.draw(ODD)
    (folder / "main_data.hdf5").write_bytes(content)
    (folder / "metadata.json").write_text(json.dumps(metadata))
    for read in (read_minari, describe_minari):
        with contextlib.suppress(UserError):
            read("plain-v0")
