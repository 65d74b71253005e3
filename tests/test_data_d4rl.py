"""D4RL's files: fetched from a server of ours, and small ones of our own with each of the real ones' traps."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from web import Server, serving

from envtf_lit.data.cards import counted_episodes, dataset_card
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources import d4rl
from envtf_lit.data.sources.d4rl import FILES, load_d4rl, read_d4rl, remote_file
from envtf_lit.data.sources.fetch import RemoteFile
from envtf_lit.errors import UserError
from envtf_lit.pipeline.download import make_dataset
from envtf_lit.robots.tasks import TASKS, get_task

HOPPER, ANT = get_task("hopper-medium-v4"), get_task("ant-medium-v4")
Columns = dict[str, np.ndarray]


def log(width: int = 11, actions: int = 3) -> Columns:
    """Episodes of 3, 2 and 4 rows: terminal, timeout, and the file's end."""
    rng = np.random.default_rng(0)
    chains = [rng.normal(size=(length + 1, width)).astype(np.float32) for length in (3, 2, 4)]
    flags = np.zeros((2, 9), bool)
    flags[0, 2] = flags[1, 4] = True
    return {
        "observations": np.concatenate([chain[:-1] for chain in chains]),
        "next_observations": np.concatenate([chain[1:] for chain in chains]),
        "actions": rng.uniform(-1, 1, (9, actions)).astype(np.float32),
        "rewards": rng.normal(size=9).astype(np.float32),
        "terminals": flags[0],
        "timeouts": flags[1],
    }


def ant_log() -> Columns:
    columns = log(27, 8)
    zeros = np.zeros((9, 84), np.float32)
    wide = {name: np.hstack([columns[name], zeros]) for name in ("observations", "next_observations")}
    return columns | wide


def write(path: Path, columns: Columns) -> Path:
    """As D4RL does: with the simulator's state and the policy's weights beside the columns."""
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, compression="gzip")
        file["infos/qpos"] = np.zeros((9, 6))
        file["metadata/algorithm"] = "SAC"
    return path


# the files


def test_every_task_has_a_file_with_a_size_and_a_sum() -> None:
    assert FILES.keys() == TASKS.keys()
    assert all(10**7 < size < 10**9 and len(bytes.fromhex(digest)) == 32 for size, digest in FILES.values())
    assert len(set(FILES.values())) == 20
    assert remote_file(get_task("walker2d-full-replay-v4")) == RemoteFile(
        (
            "https://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2/walker2d_full_replay-v2.hdf5",
            "https://huggingface.co/datasets/imone/D4RL/resolve/main/walker2d_full_replay-v2.hdf5",
        ),
        285115514,
        "f2720f9d27b2acef6ec9a7d9ad3b80b6c2078ad4467cee668a81e3b3c80bcf2a",
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where D4RL's own package looks."""
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def web(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """A server with a small file in the place of Hopper's medium one."""
    content = write(tmp_path / "served.hdf5", log()).read_bytes()
    monkeypatch.setitem(FILES, "hopper-medium", (len(content), hashlib.sha256(content).hexdigest()))
    with serving(Server(content)) as server:
        monkeypatch.setattr(d4rl, "SERVERS", (server.url.rpartition("/")[0],))
        yield server


def test_a_download_is_kept_and_found_again(folder: Path, web: Server) -> None:
    for _ in range(2):
        dataset, origin = load_d4rl(HOPPER, None, progress=False)
        assert len(dataset) == 9
        assert origin["published_file"] is True
    assert len(web.asked) == 1
    assert origin["path"] == str(folder / "hopper_medium-v2.hdf5")
    assert origin["url"] == f"{web.url.rpartition('/')[0]}/hopper_medium-v2.hdf5"
    assert (origin["bytes"], origin["sha256"]) == FILES["hopper-medium"]


@pytest.mark.usefixtures("folder", "web")
def test_the_published_file_has_d4rls_scores() -> None:
    _, origin = make_dataset(HOPPER, DownloadOptions(source="d4rl"), seed=0, workers=1, progress=False)
    assert "Scores are D4RL's own" in origin["note"]


def test_a_server_that_refuses_says_where_to_place_a_copy(folder: Path, web: Server) -> None:
    web.statuses = [403]
    with pytest.raises(UserError) as error:
        load_d4rl(HOPPER, None, progress=False)
    for part in ("hopper_medium-v2.hdf5 answers 403 Forbidden", f"copy it to {folder}", "download.path"):
        assert part in str(error.value)


def test_half_a_file_from_somebody_else_is_not_used(folder: Path, web: Server) -> None:
    folder.mkdir()
    (folder / "hopper_medium-v2.hdf5").write_bytes(web.content[:-1])
    with pytest.raises(UserError, match=r"hopper_medium-v2.hdf5 is not D4RL's file: delete it"):
        load_d4rl(HOPPER, None, progress=False)
    assert web.asked == []


def test_the_tasks_name_asks_for_the_simulator_that_the_data_are_near_to(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="set the task to hopper-medium-v4"):
        load_d4rl(get_task("hopper-medium"), write(tmp_path / "copy.hdf5", log()))


def test_a_copy_and_its_card(tmp_path: Path) -> None:
    path = write(tmp_path / "copy.hdf5", log())
    options = DownloadOptions(source="d4rl", path=str(path))
    dataset, origin = make_dataset(HOPPER, options, seed=0, workers=1, progress=False)
    card = dataset_card(dataset, "d4rl", origin)
    assert json.loads(json.dumps(card, allow_nan=False)) == card
    assert (card["task"], card["env_id"], card["source"]) == ("hopper-medium-v4", "Hopper-v4", "d4rl")
    assert card["url"].endswith("gym_mujoco_v2/hopper_medium-v2.hdf5")
    assert card["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert card["published_file"] is False and "not the file that D4RL publishes" in card["note"]
    counted = dataset.episode_returns[counted_episodes(dataset, "d4rl")]
    assert card["scores"]["max"] == pytest.approx(100 * (counted.max() + 20.272305) / 3254.572305)
    assert card["mended"] == {"constant_dimensions": 0, "clipped_velocities": 0, "unmarked_ends": 0}


# the traps


def test_next_observations_at_terminals_and_timeouts_are_the_files_own(tmp_path: Path) -> None:
    columns = log()
    dataset, _ = read_d4rl(write(tmp_path / "a.hdf5", columns), HOPPER)
    assert dataset.episode_starts.tolist() == [0, 3, 5]
    assert np.array_equal(dataset.next_observations, columns["next_observations"])
    for row in (2, 4):  # what the following row would give, and d4rl.qlearning_dataset does
        assert not np.array_equal(dataset.next_observations[row], columns["observations"][row + 1])
    assert dataset.terminated.tolist() == [False, False, True] + [False] * 6
    assert np.flatnonzero(dataset.truncated).tolist() == [4, 8]


def test_without_next_observations_no_row_looks_into_the_next_episode(tmp_path: Path) -> None:
    columns = log()
    columns.pop("next_observations")
    dataset, _ = read_d4rl(write(tmp_path / "a.hdf5", columns), HOPPER)
    kept = [0, 1, 3, 5, 6, 7]  # each episode's last row has no successor
    assert np.array_equal(dataset.observations, columns["observations"][kept])
    assert np.array_equal(dataset.next_observations, columns["observations"][[row + 1 for row in kept]])
    assert dataset.episode_starts.tolist() == [0, 2, 3]


def test_an_end_without_a_flag_is_found(tmp_path: Path) -> None:
    columns = log()
    columns["timeouts"][:] = False
    dataset, mended = read_d4rl(write(tmp_path / "a.hdf5", columns), HOPPER)
    assert mended["unmarked_ends"] == 1
    assert dataset.episode_starts.tolist() == [0, 3, 5]
    columns.pop("timeouts")  # as in the oldest files
    again, mended = read_d4rl(write(tmp_path / "b.hdf5", columns), HOPPER)
    assert mended["unmarked_ends"] == 1
    assert np.array_equal(again.truncated, dataset.truncated)


def test_rounding_is_no_end(tmp_path: Path) -> None:
    columns = log()
    columns["next_observations"] = columns["next_observations"] * np.float32(1 + 1e-6)
    assert read_d4rl(write(tmp_path / "a.hdf5", columns), HOPPER)[1]["unmarked_ends"] == 0


def test_ants_constant_dimensions_go(tmp_path: Path) -> None:
    columns = ant_log()
    dataset, mended = read_d4rl(write(tmp_path / "a.hdf5", columns), ANT)
    assert mended["constant_dimensions"] == 84
    assert np.array_equal(dataset.observations, columns["observations"][:, :27])
    assert np.array_equal(dataset.next_observations, columns["next_observations"][:, :27])
    assert ANT.robot.make().observation_space.shape == (27,)  # what policies are scored on
    narrow, mended = read_d4rl(write(tmp_path / "b.hdf5", log(27, 8)), ANT)
    assert mended["constant_dimensions"] == 0
    assert narrow.observation_dim == 27


def test_ants_contact_forces_are_not_thrown_away_in_silence(tmp_path: Path) -> None:
    columns = ant_log()
    columns["next_observations"][5, 50] = 0.1
    with pytest.raises(UserError, match="contact forces in columns 27 to 110"):
        read_d4rl(write(tmp_path / "a.hdf5", columns), ANT)


@pytest.mark.parametrize("name", ["hopper", "walker2d", "halfcheetah", "ant"])
def test_velocities_are_clipped_where_the_simulator_clips_them(tmp_path: Path, name: str) -> None:
    task = get_task(f"{name}-medium-v4")
    env = task.robot.make()
    simulator: Any = env.unwrapped
    simulator.set_state(np.full(simulator.model.nq, 20.0), np.full(simulator.model.nv, 50.0))
    shown = simulator._get_obs()[: task.robot.observation_dim]
    columns = log(task.robot.observation_dim, task.robot.action_dim)
    velocities = simulator.model.nv
    columns["observations"][0, -velocities:] = 50
    columns["observations"][1:2, :-velocities] = 20
    dataset, mended = read_d4rl(write(tmp_path / "a.hdf5", columns), task)
    assert mended["clipped_velocities"] == (velocities if task.robot.clipped_from is not None else 0)
    assert np.array_equal(dataset.observations[0, -velocities:], shown[-velocities:])
    assert (dataset.observations[1, :-velocities] == 20).all()  # positions stay
    env.close()


def test_flags_as_numbers_and_columns_of_one(tmp_path: Path) -> None:
    columns = log()
    odd = columns | {name: columns[name][:, None].astype(np.float64) for name in ("rewards", "terminals", "timeouts")}
    dataset, _ = read_d4rl(write(tmp_path / "a.hdf5", odd), HOPPER)
    assert np.array_equal(dataset.rewards, columns["rewards"])
    assert dataset.episode_starts.tolist() == [0, 3, 5]


# bad files


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        (("timeouts", "next_observations"), "neither 'timeouts' nor 'next_observations'"),
        (("rewards",), "'rewards'"),
        (("observations",), "'observations'"),
        (("terminals",), "'terminated'"),
    ],
)
def test_missing_columns(tmp_path: Path, gone: tuple[str, ...], message: str) -> None:
    columns = {name: values for name, values in log().items() if name not in gone}
    with pytest.raises(UserError, match=message):
        read_d4rl(write(tmp_path / "a.hdf5", columns), HOPPER)


@pytest.mark.parametrize("name", ["observations", "next_observations"])
@pytest.mark.parametrize("shape", [(9,), (8, 11), (9, 11, 1), (0, 11)])
def test_odd_shapes_are_refused(tmp_path: Path, name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(UserError, match=name):
        read_d4rl(write(tmp_path / "a.hdf5", log() | {name: np.zeros(shape, np.float32)}), HOPPER)


def test_another_robots_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="111 observation and 8 action dimensions"):
        read_d4rl(write(tmp_path / "a.hdf5", ant_log()), HOPPER)


def test_a_dataset_of_ours_for_another_simulator(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", log())
    with h5py.File(path, "a") as file:
        file.attrs["task"] = "hopper-medium"
    with pytest.raises(UserError, match="made for hopper-medium, not for hopper-medium-v4"):
        read_d4rl(path, HOPPER)


def test_half_a_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", log())
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(UserError, match="damaged"):
        read_d4rl(path, HOPPER)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a file"):
        load_d4rl(HOPPER, tmp_path / "none.hdf5")


def test_the_simulators_exist() -> None:
    assert {get_task(f"{name}-v4").robot.env_id for name in FILES} <= gym.registry.keys()
