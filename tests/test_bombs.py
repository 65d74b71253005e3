"""Files made to fill the memory, to take for ever, or to block: whatever reads them ends in a sentence at once."""

import os
import time
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.saved_options import checkpoint_options, model_architecture
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.data.sources.minari import read_minari, write_minari
from envtf_lit.errors import UserError
from envtf_lit.files import read_json, write_json
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.evaluate import _curves
from envtf_lit.pipeline.stage import note_timing
from envtf_lit.pipeline.yaml import load_params
from envtf_lit.policy import load_policy, save_policy
from envtf_lit.robots.tasks import get_task
from envtf_lit.training import _checkpoint, run_folder
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.zoo.snapshots import read_series
from tests.walker import walker_dataset

SECONDS, MEGABYTES = 2.0, 500
LAUGH = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
MERGES = "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 10)}]}}\n" for i in range(1, 10))


def refused(read: Callable[[Path], Any], path: Path) -> str:
    """The sentence with which reading ends, in time and without much memory."""
    before, begin = peak(), time.process_time()
    with pytest.raises(UserError) as caught:
        read(path)
    assert time.process_time() - begin < SECONDS
    assert peak() - before < MEGABYTES
    return str(caught.value)


def peak() -> float:
    """Megabytes that this process has held at most, since it was last asked; 0 where the kernel does not say."""
    status = Path("/proc/self/status")
    if not status.exists():
        return 0.0
    found = int(status.read_text().partition("VmHWM:")[2].split()[0]) / 1e3
    Path("/proc/self/clear_refs").write_text("5")
    return found


def sparse(path: Path, size: int) -> Path:
    """A file of zeros that takes no space."""
    with path.open("wb") as stream:
        stream.truncate(size)
    return path


# params.yaml, and what is given on the command line

GROWING = [LAUGH, MERGES, f"{LAUGH}seed: *a9", "seed: " + "[" * 60_000, "seed: " + "{a: " * 10_000]


@pytest.mark.parametrize("text", GROWING, ids=["aliases", "merges", "an option", "brackets", "braces"])
def test_yaml_that_grows_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text(text)
    assert "params.yaml" in refused(load_params, tmp_path / "params.yaml")
    (tmp_path / "params.yaml").write_text("seed: 1")
    refused(lambda path: load_params(path, [f"seed={text.partition(': ')[2]}"]), tmp_path / "params.yaml")


def test_aliases_as_people_write_them_are_read(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text("seed: &number 2\nthreads: *number\n")
    assert load_params(tmp_path / "params.yaml").threads == 2


def test_200_megabytes_of_options_are_refused(tmp_path: Path) -> None:
    assert "200,000,000 bytes" in refused(load_params, sparse(tmp_path / "params.yaml", 200_000_000))


# what is no file

READERS: dict[str, Callable[[Path], Any]] = {
    "params": load_params,
    "json": read_json,
    "dataset": load_dataset,
    "rollouts": load_rollouts,
    "checkpoint": lambda path: checkpoint_options(path, TransformerOptions),
    "weights": lambda path: load_policy(folder_of(path, "weights.safetensors")),
    "config": lambda path: load_policy(folder_of(path, "config.json")),
    "architecture": lambda path: model_architecture(folder_of(path, "config.json")),
    "curves": lambda path: _curves(folder_of(path, "curves.csv")),
    "zoo": lambda path: read_series(get_task("hopper-medium").robot, folder_of(path, "hopper/zoo.json")),
}


def folder_of(path: Path, name: str) -> Path:
    """A sound policy's folder in which one file is a link to this."""
    folder = path.parent / "folder"
    save_policy(folder, TanhGaussianActor(3, 2, hidden=(8,)))
    (folder / name).unlink(missing_ok=True)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).symlink_to(path)
    return folder


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_file_is_not_waited_for(reader: str, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.h5"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    refused(READERS[reader], path)


@pytest.mark.parametrize("reader", ["params", "json", "rollouts", "weights", "config", "architecture", "curves", "zoo"])
def test_a_gigabyte_of_zeros_is_not_read(reader: str, tmp_path: Path) -> None:
    refused(READERS[reader], sparse(tmp_path / "zeros", 1 << 30))


def test_a_checkpoint_that_is_a_pipe_is_set_aside(tmp_path: Path) -> None:
    run = run_folder(tmp_path, "stage", {}, [])
    run.mkdir(parents=True)
    os.mkfifo(run / "last.ckpt")
    assert _checkpoint(run, ("last",), torch.nn.Linear(1, 1)) is None
    assert [path.name for path in run.iterdir()] == ["last.ckpt.unreadable"]


# what declares more than it holds


@pytest.mark.parametrize("rows", [10**9, 1 << 40])
def test_rollouts_that_declare_what_they_do_not_hold(rows: int, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "rollouts.h5", "w") as file:
        for field in fields(Rollouts):
            file.create_dataset(field.name, (rows,), "f4", chunks=(1 << 20,), compression="gzip")
    assert "a trap" in refused(load_rollouts, tmp_path / "rollouts.h5")


@pytest.mark.parametrize("odd", [field.name for field in fields(Rollouts)])
def test_rollouts_with_a_column_of_another_length(odd: str, tmp_path: Path) -> None:
    wide = {"observations": (3,), "next_observations": (3,), "aleatoric": (4,), "actions": (2,)}
    with h5py.File(tmp_path / "rollouts.h5", "w") as file:
        for field in fields(Rollouts):
            file[field.name] = np.zeros((2, 5 + (field.name == odd), *wide.get(field.name, ())), "f4")
    assert "has shape (2, " in refused(load_rollouts, tmp_path / "rollouts.h5")


def test_a_dataset_of_ten_megabytes_that_declares_four_gigabytes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name in ("observations", "next_observations"):
            file.create_dataset(name, (10**7, 50), "f4", chunks=(10**5, 50), compression="gzip")
        file["actions"] = np.zeros((10**7, 1), "i1")
        for name in ("rewards", "terminals", "timeouts"):
            file.create_dataset(name, (10**7,), "i1", chunks=(10**5,), compression="gzip")
    assert "a trap" in refused(load_dataset, tmp_path / "log.h5")


def test_weights_that_name_hundreds_of_thousands_of_tensors(tmp_path: Path) -> None:
    one = '"t{}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}'
    header = ("{" + ",".join(one.format(i) for i in range(200_000)) + "}").encode()
    (tmp_path / "weights").write_bytes(len(header).to_bytes(8, "little") + header)
    assert "its header is of" in refused(READERS["weights"], tmp_path / "weights")


def test_a_checkpoint_that_is_a_compressed_archive(tmp_path: Path) -> None:
    torch.save({"state_dict": {}, "hyper_parameters": {"x": torch.zeros(10)}}, tmp_path / "sound.ckpt")
    with zipfile.ZipFile(tmp_path / "sound.ckpt") as sound, zipfile.ZipFile(tmp_path / "bomb.ckpt", "w", 8) as bomb:
        for name in sound.namelist():
            bomb.writestr(name, bytes(10**8) if name.endswith("/data/0") else sound.read(name))
    assert "is not a checkpoint" in refused(READERS["checkpoint"], tmp_path / "bomb.ckpt")


def minari_log(path: Path) -> Path:
    """The folder of a sound Minari dataset of four episodes."""
    write_minari(walker_dataset(episodes=4), "my/log-v0", root=path)
    return path / "my/log-v0/data"


@pytest.mark.parametrize("told", [10**9, 10**30, -1, 5, 4.0, "4", True, None])
def test_a_minari_dataset_that_tells_of_more_episodes_than_it_holds(told: Any, tmp_path: Path) -> None:
    folder = minari_log(tmp_path)
    assert len(read_minari(folder).episode_starts) == 4
    metadata = read_json(folder / "metadata.json")
    write_json(folder / "metadata.json", metadata | {"total_episodes": told})
    assert "episodes and holds 4" in refused(read_minari, folder)


@pytest.mark.parametrize("kind", ["circle", "doubling", "same array"])
def test_a_minari_dataset_whose_links_never_end(kind: str, tmp_path: Path) -> None:
    folder = minari_log(tmp_path)
    with h5py.File(folder / "main_data.hdf5", "r+") as file:
        episode: Any = file["episode_0"]
        if kind == "circle":
            episode["again"] = file["/"]
        elif kind == "same array":
            episode["again"] = file["episode_1/rewards"]
        for depth in range(40 if kind == "doubling" else 0):
            following = episode.create_group(f"left{depth}")
            episode[f"right{depth}"] = following
            episode = following
    assert "leads elsewhere" in refused(read_minari, folder)


# side files and tables of another form


@pytest.mark.parametrize("text", ["[]", "3", '"x"', "null", "{", "[" * 10**5, ""])
def test_a_damaged_side_file_is_begun_anew(text: str, tmp_path: Path) -> None:
    path = tmp_path / ".envtf/timings.json"
    path.parent.mkdir()
    path.write_text(text)
    note_timing(tmp_path, "stage", 1)
    assert read_json(path) == {"stage": 1}


def test_a_side_file_that_cannot_be_written_costs_no_work(tmp_path: Path) -> None:
    (tmp_path / ".envtf").touch()
    note_timing(tmp_path, "stage", 1)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b'a,b\n1,2,3\n"x\n', b""])
def test_curves_of_bytes_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_bytes(content)
    assert "curves.csv" in refused(_curves, tmp_path)


@pytest.mark.parametrize("content", [[], {}, 3, "x", None, {"snapshots": None}, {"snapshots": [3]}, {"snapshots": []}])
def test_a_zoo_of_another_form_is_refused(content: Any, tmp_path: Path) -> None:
    (tmp_path / "hopper").mkdir()
    write_json(tmp_path / "hopper/zoo.json", content)
    assert "zoo.json is not what" in refused(lambda path: read_series(get_task("hopper-medium").robot, path), tmp_path)
