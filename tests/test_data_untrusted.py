"""Files that want to run code, lead elsewhere, fill the memory, or are damaged."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logs import KEYS, Columns, columns, write
from rich.console import Console

from envtf_lit.data.check_report import inspect_source, render
from envtf_lit.data.dataset import COLUMNS
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError


@pytest.fixture(params=[".h5", ".npz"])
def ending(request: pytest.FixtureRequest) -> str:
    return request.param


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


def test_archive_members_that_leave_the_folder_are_refused(tmp_path: Path):
    for number, member in enumerate(("../x.npy", "/etc/x.npy", "a/../../x.npy", "..\\x.npy")):
        path = write(tmp_path / f"{number}.npz", columns())
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(member, b"anything")
        with pytest.raises(UserError, match="leaves its folder"):
            load_dataset(path)


def test_absurd_sizes_end_in_a_sentence_before_any_memory_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    content = columns()
    del content["rewards"]
    with h5py.File(write(tmp_path / "bomb.h5", content), "a") as file:
        file.create_dataset("rewards", (1 << 48,), "f8", chunks=(1 << 20,))
    with h5py.File(write(tmp_path / "chunk.h5", content), "a") as file:
        file.create_dataset("rewards", (12,), "f8", maxshape=(None,), chunks=(1 << 28,), compression="gzip")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 48,)})
    with zipfile.ZipFile(write(tmp_path / "header.npz", content), "a") as archive:
        archive.writestr("rewards.npy", header.getvalue() + bytes(96))
    monkeypatch.setattr("envtf_lit.data.sources.raw.BOMB_BYTES", 1 << 20)
    np.savez_compressed(tmp_path / "zeros.npz", allow_pickle=False, **content, rewards=np.zeros(1 << 20))
    for name, message in (
        ("bomb.h5", "a trap"),
        ("chunk.h5", "a trap"),
        ("header.npz", "holds less"),
        ("zeros.npz", "a trap"),
    ):
        with pytest.raises(UserError, match=message):
            load_dataset(tmp_path / name)


def test_filters_that_a_plugin_would_run_are_refused(tmp_path: Path):
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((12,))
    plan.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)  # Zstandard's
    content = columns()
    del content["rewards"]
    with h5py.File(write(tmp_path / "filter.h5", content), "a") as file:
        h5py.h5d.create(file.id, b"rewards", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple((12,)), plan)
    with pytest.raises(UserError, match="foreign filters"):
        load_dataset(tmp_path / "filter.h5")


@pytest.mark.parametrize("value", ["references", "long", "objects"])
def test_odd_attributes_are_not_read(tmp_path: Path, value: str):
    with h5py.File(tmp_path / "in.h5", "w", libver="latest") as file:
        for name, column in columns().items():
            file[name] = column
        if value == "references":
            file.attrs["action_low"] = file["rewards"].ref
        elif value == "long":
            file.attrs.create("action_low", np.zeros(1 << 18))
        else:
            file.attrs.create("action_low", ["a", "b", "c"], dtype=h5py.string_dtype())
    with pytest.raises(UserError, match=r"'action_low' is .*must be 3 finite numbers"):
        load_dataset(tmp_path / "in.h5")


# whatever the bytes, `envtf data check` ends in a report


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Cut short, some bytes replaced, a stretch repeated or blanked, or noise from the first byte on."""
    kind = draw(st.sampled_from(["short", "flipped", "moved", "blank", "noise"]))
    if kind == "short":
        return whole[: draw(st.integers(0, len(whole) - 1))]
    if kind == "noise":
        return draw(st.sampled_from([b"", whole[:8]])) + draw(st.binary(max_size=200))
    broken = bytearray(whole)
    if kind == "flipped":
        for position in draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=8)):
            broken[position] = draw(st.integers(0, 255))
        return bytes(broken)
    begin, length = draw(st.integers(0, len(whole) - 1)), draw(st.integers(1, 64))
    source = draw(st.integers(0, len(whole) - 1)) if kind == "moved" else None
    stretch = bytes(length) if source is None else whole[source : source + length]
    broken[begin : begin + length] = stretch[: len(broken[begin : begin + length])]
    return bytes(broken)


@st.composite
def odd_content(draw: st.DrawFn) -> Columns:
    """Columns of unfit types, shapes, names and values among sound ones."""
    content = columns() | draw(
        st.sampled_from([{}, {"episode_index": np.repeat([0, 1, 2], 4)}, {"action_low": -np.ones(3)}])
    )
    for name in draw(st.lists(st.sampled_from([*KEYS, "episode_index"]), max_size=2, unique=True)):
        content.pop(name, None)
    for name in draw(
        st.lists(st.sampled_from([*KEYS, "episode_index", "terminated", "task"]), max_size=3, unique=True)
    ):
        dtype = draw(st.sampled_from(["f2", "f4", ">f4", "f8", "i1", "i8", "u8", "?", "c8", "S3"]))
        shape = tuple(draw(st.lists(st.sampled_from([0, 1, 3, 11, 12]), max_size=3)))
        value = draw(st.sampled_from([0, 1, 2, -1, 0.5, 1e30, np.nan, -np.inf]))
        with np.errstate(all="ignore"):
            content[name] = np.full(shape, value).astype(dtype)
    return content


@st.composite
def malformed(draw: st.DrawFn, path: Path) -> None:
    """Writes a file with something wrong, most of the time."""
    compressed = draw(st.booleans())
    write(path, draw(st.one_of(st.just(columns()), odd_content())), compressed=compressed)
    if draw(st.booleans()):
        path.write_bytes(draw(damaged(path.read_bytes())))


def check_ends_in_a_report(path: Path, data: st.DataObject) -> None:
    """Of a small file, or of one whose columns stay there because it counts as large."""
    data.draw(malformed(path))
    with mock.patch("envtf_lit.data.sources.files.RESIDENT_BYTES", data.draw(st.sampled_from([0, 1 << 28]))):
        check_report_and_loading(path)


def check_report_and_loading(path: Path) -> None:
    inspection = inspect_source(path)
    shown = io.StringIO()
    Console(file=shown).print(render(inspection))
    assert ("not usable" in shown.getvalue()) == (not inspection.usable)
    assert (inspection.dataset is None) <= (not inspection.usable)
    if inspection.dataset is None:
        with pytest.raises(UserError):
            load_dataset(path)
        return
    dataset = load_dataset(path)
    assert all(len(getattr(dataset, name)) == len(dataset) > 0 for name in COLUMNS)
    assert all(np.isfinite(np.asarray(getattr(dataset, name))).all() for name in COLUMNS)
    assert dataset.episode_lengths.min() >= 1
    assert (dataset.terminated | dataset.truncated)[dataset.episode_ends - 1].all()
    actions = np.asarray(dataset.actions)
    assert ((actions >= dataset.action_low) & (actions <= dataset.action_high)).all()


PROPERTY = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])


@settings(PROPERTY, max_examples=50)
@given(data=st.data())
def test_malformed_files_end_in_a_report(tmp_path: Path, ending: str, data: st.DataObject):
    check_ends_in_a_report(tmp_path / f"malformed{ending}", data)


@pytest.mark.slow
@settings(PROPERTY, max_examples=1_500)
@given(data=st.data())
def test_thousands_of_malformed_files_end_in_a_report(tmp_path: Path, ending: str, data: st.DataObject):
    check_ends_in_a_report(tmp_path / f"malformed{ending}", data)
