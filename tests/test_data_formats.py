"""Files: round trips, D4RL's variants, and every kind of bad input as one readable sentence."""

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envtf_lit.data.dataset import COLUMNS, OfflineDataset
from envtf_lit.data.formats import load_dataset, save_dataset
from envtf_lit.errors import UserError

KEYS = ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
Columns = dict[str, Any]


def columns(observation_dim: int = 11, action_dim: int = 3) -> Columns:
    """Three episodes of 4, 3 and 5 rows: terminated, timed out, cut by the end of the log."""
    rng = np.random.default_rng(0)
    rows = 12
    flags = np.zeros((2, rows), bool)
    flags[0, 3] = flags[1, 6] = True
    return {
        "observations": rng.normal(size=(rows, observation_dim)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, action_dim)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "next_observations": rng.normal(size=(rows, observation_dim)).astype(np.float32),
        "terminals": flags[0],
        "timeouts": flags[1],
    }


def write(path: Path, content: Columns) -> Path:
    if path.suffix == ".npz":
        np.savez(path, allow_pickle=True, **content)
        return path
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            if name in ("task", "action_low", "action_high"):
                file.attrs[name] = value
            else:
                file[name] = value
    return path


def assert_equal(first: OfflineDataset, second: OfflineDataset) -> None:
    for name in (*COLUMNS, "episode_starts", "action_low", "action_high"):
        one, two = getattr(first, name), getattr(second, name)
        assert one.dtype == two.dtype, name
        assert np.array_equal(one, two), name
    assert first.task == second.task


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


def test_a_lone_row_after_the_last_ending_is_left_out(tmp_path: Path, ending: str):
    content = columns()
    content["timeouts"][10] = True
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    assert len(dataset) == 11
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
    assert load_dataset(write(tmp_path / f"in{ending}", content)).actions.max() == 1


def test_stored_action_limits_are_used(tmp_path: Path, ending: str):
    content = columns() | {"action_low": np.full(3, -2.0), "action_high": np.full(3, 3.0)}
    content["actions"][0, 0] = 2.5
    dataset = load_dataset(write(tmp_path / f"in{ending}", content))
    assert dataset.action_low.tolist() == [-2] * 3
    assert dataset.action_high.tolist() == [3] * 3


def put(name: str, value: Any) -> Callable[[Columns], None]:
    return lambda content: content.update({name: value})


def change(name: str, function: Callable[[np.ndarray], Any]) -> Callable[[Columns], None]:
    return lambda content: content.update({name: function(content[name])})


def at(name: str, index: Any, value: float) -> Callable[[Columns], None]:
    return lambda content: content[name].__setitem__(index, value)


def empty(content: Columns) -> None:
    for name in KEYS:
        content[name] = content[name][:0]


BAD = {
    "no observations": (lambda content: content.pop("observations"), "has no 'observations'"),
    "no actions": (lambda content: content.pop("actions"), "has no 'actions'"),
    "no rewards": (lambda content: content.pop("rewards"), "has no 'rewards'"),
    "no terminals": (lambda content: content.pop("terminals"), r"has no 'terminated' \(or 'terminals'\)"),
    "no timeouts": (lambda content: content.pop("timeouts"), r"has no 'truncated' \(or 'timeouts'\)"),
    "short": (change("actions", lambda x: x[:-1]), "'actions' has 11 rows and 'rewards' has 12"),
    "rank 1": (change("observations", lambda x: x[:, 0]), r"'observations' has shape \(12,\)"),
    "rank 2": (change("rewards", lambda x: x[:, None]), r"'rewards' has shape \(12, 1\)"),
    "scalar": (put("rewards", 1.0), r"'rewards' has shape \(\)"),
    "narrow": (change("next_observations", lambda x: x[:, :3]), "they must be equal"),
    "no dimensions": (change("actions", lambda x: x[:, :0]), "which is empty"),
    "nan": (at("observations", (5, 2), np.nan), r"'observations' has NaN or infinite values, first at row 5 \(1 rows"),
    "infinite": (at("rewards", slice(3, 5), np.inf), r"'rewards' has NaN or infinite values, first at row 3 \(2 rows"),
    "huge": (put("rewards", np.full(12, 1e300)), "'rewards' has NaN or infinite"),
    "flag": (change("terminals", lambda x: x + 2), "'terminated' is 2 at row 0"),
    "nan flag": (put("timeouts", np.full(12, np.nan)), "'truncated' is nan at row 0"),
    "action": (at("actions", (4, 1), 1.5), r"actions reach from -\d\.\d+ to 1\.5, outside .*\[-1, 1\], first at row 4"),
    "zero rows": (empty, "which is empty"),
    "one-step episode": (at("timeouts", 4, True), "1 of 4 episodes have fewer than two steps, first at row 4"),
    "action limits": (put("action_low", np.full(3, 2.0)), "is not below"),
    "action limit shape": (put("action_low", np.full(2, -1.0)), "must be 3 finite numbers"),
    "action limit type": (put("action_high", "high"), "must be 3 finite numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_content_is_named_in_one_sentence(tmp_path: Path, ending: str, case: str):
    spoil, message = BAD[case]
    content = columns()
    spoil(content)
    path = write(tmp_path / f"bad{ending}", content)
    with pytest.raises(UserError, match=message) as caught:
        load_dataset(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("values", [np.array(["a"] * 12), np.array([1j] * 12), np.array([{}] * 12)])
def test_npz_without_numbers(tmp_path: Path, values: np.ndarray):
    """An array of objects would need pickle, which can run code."""
    with pytest.raises(UserError):
        load_dataset(write(tmp_path / "bad.npz", columns() | {"rewards": values}))


def hdf5_traps(folder: Path) -> dict[str, Callable[[h5py.File], Any]]:
    other = folder / "other.h5"
    write(other, columns())

    def external_storage(file: h5py.File) -> None:
        file.create_dataset("rewards", (12,), "f4", external=[(str(other), 0, 48)])

    def virtual(file: h5py.File) -> None:
        layout = h5py.VirtualLayout((12,), "f4")
        layout[:] = h5py.VirtualSource(str(other), "rewards", shape=(12,))
        file.create_virtual_dataset("rewards", layout)

    return {
        "external link": lambda file: file.__setitem__("rewards", h5py.ExternalLink(str(other), "rewards")),
        "soft link": lambda file: file.__setitem__("rewards", h5py.SoftLink("/actions")),
        "dangling link": lambda file: file.__setitem__("rewards", h5py.SoftLink("/nowhere")),
        "external storage": external_storage,
        "virtual": virtual,
        "group": lambda file: file.create_group("rewards"),
        "references": lambda file: file.create_dataset("rewards", (12,), h5py.ref_dtype),
        "strings": lambda file: file.create_dataset("rewards", data=["a"] * 12),
        "nothing": lambda file: file.create_dataset("rewards", data=h5py.Empty("f4")),
    }


@pytest.mark.parametrize(
    "trap",
    [
        "external link",
        "soft link",
        "dangling link",
        "external storage",
        "virtual",
        "group",
        "references",
        "strings",
        "nothing",
    ],
)
def test_hdf5_that_leads_elsewhere_or_holds_no_numbers(tmp_path: Path, trap: str):
    content = columns()
    del content["rewards"]
    path = write(tmp_path / "bad.h5", content)
    with h5py.File(path, "a") as file:
        hdf5_traps(tmp_path)[trap](file)
    with pytest.raises(UserError, match="no plain numeric array under 'rewards'"):
        load_dataset(path)


@pytest.mark.parametrize(
    ("task", "dims", "message"),
    [
        ("ant-medium", (11, 3), "11 observation and 3 action dimensions, and Ant-v5 has 27 and 8"),
        ("hopper-mediun", (11, 3), "did you mean 'hopper-medium'"),
        ("walker2d-medium", (17, 6), "was made for halfcheetah-random, not for walker2d-medium"),
    ],
)
def test_task_that_does_not_fit(tmp_path: Path, ending: str, task: str, dims: tuple[int, int], message: str):
    content = columns(*dims) | ({"task": "halfcheetah-random"} if dims[0] == 17 else {})
    with pytest.raises(UserError, match=message):
        load_dataset(write(tmp_path / f"bad{ending}", content), task=task)


@pytest.mark.parametrize("task", ["hopper-medium-v2", 3.0])
def test_a_task_of_others_is_no_task_of_ours(tmp_path: Path, ending: str, task: Any):
    assert load_dataset(write(tmp_path / f"in{ending}", columns() | {"task": task})).task is None


def test_missing_file_folder_and_ending(tmp_path: Path, ending: str):
    with pytest.raises(UserError, match="is not a file"):
        load_dataset(tmp_path / f"none{ending}")
    (tmp_path / f"folder{ending}").mkdir()
    with pytest.raises(UserError, match="is not a file"):
        load_dataset(tmp_path / f"folder{ending}")
    (tmp_path / "data.csv").write_text("1,2\n")
    with pytest.raises(UserError, match=r"ends in '.csv': name a dataset .h5, .hdf5 or .npz"):
        load_dataset(tmp_path / "data.csv")


def test_a_full_disk_leaves_the_old_file_whole(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch):
    dataset = load_dataset(write(tmp_path / f"in{ending}", columns()))
    path = tmp_path / f"out{ending}"
    path.write_bytes(b"old")

    def fill_up(self: Path, content: bytes) -> int:
        with self.open("wb") as file:
            file.write(content[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(UserError, match="No space left while writing"):
        save_dataset(dataset, path)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("kind", ["text", "empty", "the other format", "pickle"])
def test_not_the_format(tmp_path: Path, ending: str, kind: str):
    path = tmp_path / f"bad{ending}"
    if kind == "text":
        path.write_text("observations, actions\n")
    elif kind == "empty":
        path.touch()
    elif kind == "pickle":
        np.save(tmp_path / "objects.npy", np.array([{}]), allow_pickle=True)
        (tmp_path / "objects.npy").rename(path)
    else:
        write(tmp_path / f"other{'.npz' if ending == '.h5' else '.h5'}", columns()).rename(path)
    with pytest.raises(UserError, match="damaged or not an"):
        load_dataset(path)


def damage(draw: st.DrawFn, whole: bytes) -> bytes:
    """Cut short, some bytes replaced, or noise from the first byte on."""
    kind = draw(st.sampled_from(["truncated", "flipped", "noise"]))
    if kind == "truncated":
        return whole[: draw(st.integers(0, len(whole) - 1))]
    if kind == "noise":
        return draw(st.binary(max_size=200))
    broken = bytearray(whole)
    for position in draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=8)):
        broken[position] = draw(st.integers(0, 255))
    return bytes(broken)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_bytes_give_a_sound_dataset_or_a_user_error(tmp_path: Path, ending: str, data: st.DataObject):
    path = write(tmp_path / f"damaged{ending}", columns())
    path.write_bytes(data.draw(st.composite(damage)(path.read_bytes())))
    assert_sound_or_user_error(path)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_odd_columns_give_a_sound_dataset_or_a_user_error(tmp_path: Path, ending: str, data: st.DataObject):
    content = columns()
    for name in data.draw(st.lists(st.sampled_from(KEYS), min_size=1, max_size=3, unique=True)):
        dtype = data.draw(st.sampled_from(["f2", "f4", "f8", "i1", "i8", "u4", "?", "c8", "S3"]))
        shape = tuple(data.draw(st.lists(st.sampled_from([0, 1, 3, 11, 12]), max_size=3)))
        content[name] = np.full(shape, data.draw(st.sampled_from([0, 1, 2, -1])), dtype)
    assert_sound_or_user_error(write(tmp_path / f"odd{ending}", content))


def assert_sound_or_user_error(path: Path) -> None:
    try:
        dataset = load_dataset(path)
    except UserError:
        return
    assert all(len(getattr(dataset, name)) == len(dataset) > 0 for name in COLUMNS)
    assert all(np.isfinite(getattr(dataset, name)).all() for name in COLUMNS)
    assert dataset.episode_lengths.min() >= 1
    assert np.abs(dataset.actions).max() <= 1
