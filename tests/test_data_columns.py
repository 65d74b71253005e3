"""Large files stay where they are: the same rows, the same batches and the same weights, to the bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from walker import walker_dataset

from envtf_lit.data.check_report import inspect_source
from envtf_lit.data.columns import FileRows
from envtf_lit.data.dataset import COLUMNS
from envtf_lit.data.loaders import Store, Transitions, Windows
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.devices import pick_device
from envtf_lit.errors import UserError
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.pipeline.yaml import preset_params

WIDE = ("observations", "actions", "next_observations")


@pytest.fixture
def matrix(tmp_path: Path) -> tuple[np.ndarray, FileRows]:
    """Seventeen rows of three, and the same in a file, after five bytes of something else."""
    rows = np.random.default_rng(0).normal(size=(17, 3)).astype(np.float32)
    (tmp_path / "rows").write_bytes(b"12345" + rows.tobytes())
    return rows, FileRows(tmp_path / "rows", 5, (17, 3))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_rows_of_a_file_are_those_of_the_array(matrix: tuple[np.ndarray, FileRows], data: st.DataObject):
    array, rows = matrix
    if data.draw(st.booleans()):
        chosen = np.array(data.draw(st.lists(st.integers(0, 16), min_size=1, max_size=20)))
        array, rows = array[chosen], rows.select(chosen)
    assert (rows.shape, len(rows), rows.nbytes, rows.dtype) == (array.shape, len(array), array.nbytes, array.dtype)
    if data.draw(st.booleans()):
        index = slice(*data.draw(st.tuples(*[st.one_of(st.none(), st.integers(0, 20))] * 2)))
    else:
        shape = tuple(data.draw(st.lists(st.integers(0, 4), max_size=3)))
        index = np.random.default_rng(data.draw(st.integers(0, 9))).integers(0, len(array), shape)
    found = rows[index]
    assert np.array_equal(found, array[index]) and found.dtype == array.dtype and found.shape == array[index].shape
    assert np.array_equal(np.asarray(rows), array)


def test_rows_that_are_not_there(matrix: tuple[np.ndarray, FileRows], tmp_path: Path):
    _, rows = matrix
    for index in ([17], [-1], [0, 99]):
        with pytest.raises(IndexError, match="of a column of 17"):
            rows[np.array(index)]
    with (tmp_path / "rows").open("r+b") as file:
        file.truncate(100)
    with pytest.raises(UserError, match="has become shorter"):
        rows[np.array([16])]


def test_a_file_that_is_replaced_does_no_harm(matrix: tuple[np.ndarray, FileRows], tmp_path: Path):
    array, rows = matrix
    (tmp_path / "new").write_bytes(b"other")
    (tmp_path / "new").replace(tmp_path / "rows")
    assert np.array_equal(np.asarray(rows), array)


# datasets


@pytest.fixture
def in_file(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Every file counts as a large one."""
    monkeypatch.setattr("envtf_lit.data.sources.files.RESIDENT_BYTES", 0)
    return monkeypatch


@pytest.mark.parametrize("ending", [".h5", ".npz"])
def test_wide_columns_of_large_files_stay_there(tmp_path: Path, ending: str, in_file: pytest.MonkeyPatch):
    dataset = walker_dataset()
    save_dataset(dataset, tmp_path / f"log{ending}")
    read = load_dataset(tmp_path / f"log{ending}")
    assert all(isinstance(getattr(read, name), FileRows) for name in WIDE)
    assert isinstance(read.rewards, np.ndarray)
    for name in COLUMNS:
        assert np.array_equal(getattr(read, name), getattr(dataset, name)), name
    for one, two in zip(read.split(0.3, seed=0), dataset.split(0.3, seed=0), strict=True):
        assert isinstance(one.observations, FileRows)
        for name in (*COLUMNS, "episode_starts"):
            assert np.array_equal(getattr(one, name), getattr(two, name)), name
    save_dataset(read, tmp_path / f"again{ending}")
    assert (tmp_path / f"again{ending}").read_bytes() == (tmp_path / f"log{ending}").read_bytes()


def test_what_cannot_be_read_in_place_is_read_whole(tmp_path: Path, in_file: pytest.MonkeyPatch):
    dataset = walker_dataset()
    arrays = {name: np.asarray(getattr(dataset, name)) for name in COLUMNS}
    np.savez_compressed(tmp_path / "small.npz", allow_pickle=False, **arrays)
    np.savez(tmp_path / "double.npz", allow_pickle=False, **arrays | {"actions": arrays["actions"].astype(np.float64)})
    columns_first = {name: np.asfortranarray(values) for name, values in arrays.items()}
    np.savez(tmp_path / "turned.npz", allow_pickle=False, **columns_first)
    for name, kept in (("small", ()), ("double", ("observations", "next_observations")), ("turned", ())):
        read = load_dataset(tmp_path / f"{name}.npz")
        assert [column for column in COLUMNS if isinstance(getattr(read, column), FileRows)] == sorted(
            kept, key=COLUMNS.index
        )
        assert all(np.array_equal(getattr(read, column), arrays[column]) for column in COLUMNS)


def test_shifted_successors_are_read_in_place(tmp_path: Path, in_file: pytest.MonkeyPatch):
    arrays = {name: getattr(walker_dataset(), name) for name in COLUMNS if name != "next_observations"}
    np.savez(tmp_path / "log.npz", allow_pickle=False, **arrays)
    read = load_dataset(tmp_path / "log.npz")
    in_file.undo()
    resident = load_dataset(tmp_path / "log.npz")
    assert isinstance(read.next_observations, FileRows)
    assert all(np.array_equal(getattr(read, name), getattr(resident, name)) for name in COLUMNS)


def test_the_check_of_a_large_file_says_the_same(tmp_path: Path, in_file: pytest.MonkeyPatch):
    save_dataset(walker_dataset(), tmp_path / "log.h5")
    large = inspect_source(tmp_path / "log.h5")
    in_file.undo()
    assert inspect_source(tmp_path / "log.h5").findings == large.findings


def test_branch_points_are_the_same(tmp_path: Path, in_file: pytest.MonkeyPatch):
    save_dataset(walker_dataset(), tmp_path / "log.h5")
    drawn = []
    for dataset in (walker_dataset(), load_dataset(tmp_path / "log.h5")):
        drawn.append(BranchPoints(dataset).draw(20, 3, torch.Generator().manual_seed(0)))
    one, two = (vars(histories) for histories in drawn)
    assert len(one) == 4 and all(torch.equal(one[name], two[name]) for name in one if one[name] is not None)


@pytest.mark.parametrize("fits", [True, False])
def test_a_device_gathers_the_same_rows(tmp_path: Path, in_file: pytest.MonkeyPatch, fits: bool):
    save_dataset(walker_dataset(), tmp_path / "log.h5")
    in_file.setattr("envtf_lit.data.loaders._fits", lambda size, device: fits)
    dataset, device, rows = load_dataset(tmp_path / "log.h5"), pick_device(), torch.tensor([[0, 3], [9, 9]])
    there, here = Store(dataset, WIDE, device), Store(dataset, WIDE)
    assert all(isinstance(column, torch.Tensor) == fits for column in there.columns.values())
    for name, column in there[rows].items():
        assert column.device.type == device.type
        assert torch.equal(column.cpu(), here[rows][name])
    for kind in (
        lambda where: Windows(dataset, 4, where),
        lambda where: Transitions(dataset, discount=0.9, device=where),
    ):
        for name, column in kind(device)[rows[0]].items():
            assert torch.equal(column.cpu(), kind("cpu")[rows[0]][name]), name


# training


def train(root: Path) -> dict[str, bytes]:
    """The weights of a world model, a clone and a policy, and the imagined rollouts."""
    tiny = preset_params("tiny")
    few = {name: replace(options, updates=30, updates_per_epoch=10) for name, options in tiny.train_policy.items()}
    params = replace(
        tiny,
        threads=1,
        train_model={"transformer": replace(tiny.train_model["transformer"], updates=10, updates_per_epoch=5)},
        train_policy=few,
    )
    train_model(params, root, progress=False)
    train_policy(params, root, name="bc", progress=False)
    generate_rollouts(params, root, progress=False)
    train_policy(params, root, name="et_cql", progress=False)
    folders = ("world_model/transformer", "policy/bc", "policy/et_cql")
    weights = {name: (root / "models" / name / "weights.safetensors").read_bytes() for name in folders}
    return weights | {"rollouts": (root / "data/rollouts/transformer.h5").read_bytes()}


def test_every_stage_learns_the_same_bits_from_memory_and_from_the_file(tmp_path: Path, in_file: pytest.MonkeyPatch):
    in_file.setattr("envtf_lit.data.columns.BLOCK_BYTES", 2000)  # statistics are merged from several blocks
    save_dataset(walker_dataset().with_split(0.2, 0), tmp_path / "data/dataset.h5")
    assert isinstance(load_dataset(tmp_path / "data/dataset.h5").observations, FileRows)
    from_file = train(tmp_path)
    in_file.setattr("envtf_lit.data.sources.files.RESIDENT_BYTES", 1 << 30)
    assert isinstance(load_dataset(tmp_path / "data/dataset.h5").observations, np.ndarray)
    assert train(tmp_path) == from_file
