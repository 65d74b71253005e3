"""Minari's own library reads what we write, and we read what it writes."""

import contextlib
import hashlib
import json
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import gymnasium as gym
import h5py
import huggingface_hub.constants
import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from envtf_lit.data.dataset import COLUMNS, OfflineDataset
from envtf_lit.data.minari_sets import describe_minari, read_minari, write_minari
from envtf_lit.errors import UserError
from envtf_lit.hidden_dynamics import HiddenDynamics

PLAIN = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
ACTIONS = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """All Minari datasets of a test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def make_dataset(task: str | None = None, width: int = 4, actions: int = 2) -> OfflineDataset:
    """Episodes of 3, 2 and 4 steps: terminated, truncated, and one that the log cuts."""
    rng = np.random.default_rng(0)
    lengths = (3, 2, 4)
    chains = [rng.normal(size=(length + 1, width)).astype(np.float32) for length in lengths]
    terminated, truncated = np.zeros(9, bool), np.zeros(9, bool)
    terminated[2] = truncated[4] = truncated[8] = True
    return OfflineDataset(
        observations=np.concatenate([chain[:-1] for chain in chains]),
        actions=rng.uniform(-1, 1, (9, actions)).astype(np.float32),
        rewards=rng.normal(size=9).astype(np.float32),
        next_observations=np.concatenate([chain[1:] for chain in chains]),
        terminated=terminated,
        truncated=truncated,
        episode_starts=np.array([0, 3, 5]),
        action_low=np.full(actions, -1, np.float32),
        action_high=np.full(actions, 1, np.float32),
        task=task,
    )


def write_raw(root: Path, episodes: list[EpisodeBuffer], observations: gym.Space = PLAIN, actions: gym.Space = ACTIONS):
    """A dataset written by Minari's library: `raw-v0`."""
    (root / "raw-v0").mkdir(parents=True)
    storage = MinariStorage.new(root / "raw-v0/data", observation_space=observations, action_space=actions)
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
    dataset = make_dataset()
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
    dataset = make_dataset(task, width, 8)
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
    write_minari(make_dataset(), "plain-v0")
    theirs = minari.load_dataset("plain-v0")
    assert "No environment is known" in theirs.storage.metadata["description"]
    with pytest.raises(ValueError, match="cannot be recovered"):
        theirs.recover_environment()


def test_episodes_are_split_where_a_next_observation_is_not_the_following_row() -> None:
    dataset = make_dataset()
    np.asarray(dataset.next_observations)[6] += 1  # within the third episode, after its second step
    assert write_minari(dataset, "split-v0") == 1
    again = read_minari("split-v0")
    assert again.episode_starts.tolist() == [0, 3, 5, 7]
    assert again.truncated.tolist() == [False] * 4 + [True, False, True, False, True]
    for name in ("observations", "actions", "rewards", "next_observations", "terminated"):
        assert np.array_equal(getattr(dataset, name), getattr(again, name)), name


def test_a_folder_elsewhere(tmp_path: Path) -> None:
    write_minari(make_dataset(), "plain-v0", root=tmp_path / "elsewhere")
    with pytest.raises(UserError, match="no Minari dataset plain-v0"):
        read_minari("plain-v0")
    for folder in (tmp_path / "elsewhere/plain-v0", tmp_path / "elsewhere/plain-v0/data"):
        assert len(read_minari(folder)) == 9


def test_nothing_half_written_stays(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episodes", fail)
    with pytest.raises(UserError, match="No space left"):
        write_minari(make_dataset(), "plain-v0")
    assert list(root.rglob("*")) == []


def test_a_dataset_that_exists_is_left_alone() -> None:
    write_minari(make_dataset(), "plain-v0")
    with pytest.raises(UserError, match="another name or version"):
        write_minari(make_dataset(), "plain-v0")


# what Minari's library writes


def test_endings_come_from_the_flags_or_the_end_of_the_episode(root: Path) -> None:
    write_raw(root, [episode(3, terminated=True), episode(2, truncated=True), episode(2), episode(1, start=90)])
    dataset = read_minari("raw-v0")
    assert dataset.episode_starts.tolist() == [0, 3, 5, 7]
    assert np.flatnonzero(dataset.terminated).tolist() == [2]
    assert np.flatnonzero(dataset.truncated).tolist() == [4, 6, 7]
    assert dataset.next_observations[2].tolist() == [6.0, 7.0]  # the last observation, not the next episode's first
    assert dataset.action_high.tolist() == [2.0]


def test_facts_for_the_card(root: Path) -> None:
    write_minari(make_dataset("ant-random", 27, 8), "ours/ant-v0")
    facts = describe_minari("ours/ant-v0")
    assert json.loads(json.dumps(facts)) == facts
    assert (facts["minari_id"], facts["collected_in"], facts["total_steps"]) == ("ours/ant-v0", "Ant-v5", 9)
    assert facts["bytes"] == (root / "ours/ant-v0/data/main_data.hdf5").stat().st_size
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
def test_spaces_that_are_no_vectors(root: Path, observations: gym.Space, actions: gym.Space, message: str) -> None:
    write_raw(root, [], observations, actions)
    with pytest.raises(UserError, match=message):
        read_minari("raw-v0")


# bad input


@pytest.mark.parametrize("dataset_id", ["no-version", "../up-v0", "sp ace-v0", ""])
def test_malformed_ids(dataset_id: str) -> None:
    with pytest.raises(UserError, match="not a Minari id"):
        write_minari(make_dataset(), dataset_id)


def test_a_robot_of_another_size() -> None:
    write_minari(make_dataset(), "plain-v0")
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
        ("texts", "damaged"),
    ],
)
def test_damaged_sets_are_refused_with_a_sentence(root: Path, how: str, message: str) -> None:
    write_minari(make_dataset(), "plain-v0")
    damage(root / "plain-v0/data", how)
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
        write_minari(make_dataset("ant-random", 27, 8), "plain-v0")
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


# remote


@dataclass
class Hub:
    """As much of a Hugging Face remote as its client asks for.

    Attributes:
        files: content by path inside the one repository, `farama-minari/ours`.
        asked: paths that were fetched.
    """

    files: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def answer(self, path: str) -> bytes | None:
        if path.startswith("/api/datasets?") and self.files:
            return json.dumps([{"_id": "0" * 24, "id": "farama-minari/ours"}]).encode()
        if path.startswith("/api/datasets/farama-minari/ours/tree/"):
            tree = [{"type": "file", "path": k, "size": len(v), "oid": SHA} for k, v in self.files.items()]
            return json.dumps(tree).encode()
        if path.startswith("/api/datasets/farama-minari/ours/"):
            return json.dumps({"_id": "0" * 24, "id": "farama-minari/ours", "sha": SHA, "siblings": []}).encode()
        name = path.partition(f"/resolve/{SHA if SHA in path else 'main'}/")[2]
        self.asked.append(name)
        return self.files.get(name)


SHA = "a" * 40


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A remote on this machine that knows no dataset, until a test gives it some."""
    remote = Hub()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = remote.answer(self.path)
            self.send_response(404 if content is None else 200)
            if content is None and "/resolve/" in self.path:
                self.send_header("X-Error-Code", "EntryNotFound")
            self.send_header("Content-Length", str(len(content or b"")))
            self.send_header("X-Repo-Commit", SHA)
            self.send_header("ETag", f'"{hashlib.sha1(content or b"").hexdigest()}"')
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content or b"")

        do_HEAD = do_GET

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", url)
        monkeypatch.setattr(
            huggingface_hub.constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        yield remote
        server.shutdown()


@pytest.mark.usefixtures("hub")
def test_a_remote_that_fails_is_named_with_a_way_out(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"Cannot fetch the Minari dataset mujoco/hopper/medium-v0 .*404.* copy its"):
        read_minari("mujoco/hopper/medium-v0", download=True)
    assert capsys.readouterr().out == ""
    assert list(root.rglob("metadata.json")) == []


def test_a_dataset_that_is_here_is_not_fetched(hub: Hub) -> None:
    write_minari(make_dataset(), "plain-v0")
    assert len(read_minari("plain-v0", download=True)) == 9
    assert hub.asked == []


@pytest.mark.parametrize("left", [False, True])
def test_a_remote_dataset_is_fetched_even_where_a_download_broke(
    root: Path, tmp_path: Path, hub: Hub, left: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    write_minari(make_dataset(), "ours/plain-v0", root=tmp_path / "elsewhere")
    source = tmp_path / "elsewhere/ours"
    hub.files = {str(path.relative_to(source)): path.read_bytes() for path in source.rglob("*") if path.is_file()}
    hub.files["namespace_metadata.json"] = json.dumps({"datasets": ["ours/plain-v0"]}).encode()
    if left:  # what minari itself would take for the dataset
        (root / "ours/plain-v0/data").mkdir(parents=True)
        (root / "ours/plain-v0/data/metadata.json").write_bytes(hub.files["plain-v0/data/metadata.json"])
    assert len(read_minari("ours/plain-v0", download=True)) == 9
    assert "plain-v0/data/main_data.hdf5" in hub.asked
    assert capsys.readouterr().out == ""
