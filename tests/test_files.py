"""Files and folders: what is there stays whole until its successor is whole, and nothing half-written is left."""

import contextlib
import errno
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import recover, replacing, write_json, write_text
from envtf_lit.policy import load_policy, save_policy
from tests.full_disk import full_disk
from tests.processes import begun
from tests.walker import walker_dataset


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    save_policy(tmp_path / "policy", TanhGaussianActor(3, 2, hidden=(8,)))
    return tmp_path / "policy"


def test_a_place_below_a_file_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file/numbers.json", tmp_path / "file/deeper/numbers.json"):
        with pytest.raises(UserError, match=r"numbers\.json: .*file is a file, not a folder; choose another place"):
            write_json(path, [1])
    with pytest.raises(UserError, match="File name too long; choose another place"):
        write_json(tmp_path / ("x" * 300), [1])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_that_goes_while_it_is_written_to_is_named(tmp_path: Path) -> None:
    def write() -> None:
        with replacing(tmp_path / "folder/file") as temporary:
            (tmp_path / "folder").rmdir()
            temporary.write_text("")

    with pytest.raises(UserError, match="No such file or directory; choose another place"):
        write()


def test_what_the_block_cannot_read_is_not_blamed_on_the_place(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "file"):
        (tmp_path / "input").read_text()
    assert list(tmp_path.iterdir()) == []


def test_a_file_never_takes_the_place_of_a_folder_nor_a_folder_that_of_a_file(policy: Path, tmp_path: Path) -> None:
    before = sorted(policy.iterdir())
    with pytest.raises(UserError, match="policy: a folder of that name stands there"):
        write_json(policy, [1])
    assert sorted(policy.iterdir()) == before
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="file: a file of that name stands there"):
        save_policy(tmp_path / "file", load_policy(policy))
    assert (tmp_path / "file").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "policy"]


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    dataset, actor = walker_dataset(episodes=100), TanhGaussianActor(30, 20)
    save_policy("policy", TanhGaussianActor(3, 2, hidden=(8,)))
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    writers: list[Callable[[], None]] = [
        lambda: save_policy("policy", actor),
        lambda: write_json("numbers.json", list(range(10_000))),
        lambda: save_dataset(dataset, "data.h5"),
        lambda: save_dataset(dataset, "data.npz"),
    ]
    for write in writers:
        with full_disk(20_000), pytest.raises(UserError, match=r"^No space left while writing"):
            write()
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


# what stands there while something else takes its place


def write_folder(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.mkdir()
        for name in ("one", "two"):
            (temporary / name).write_text(text)


def texts(folder: Path) -> list[str]:
    """The two files' texts, which were written together."""
    assert sorted(path.name for path in folder.iterdir()) == ["one", "two"]
    found = [path.read_text() for path in folder.iterdir()]
    assert len(set(found)) == 1
    return found


def reaches(path: Path, k: int, *, kill: bool) -> bool:
    """Writes `new` in a process that dies, or meets an error, at its k-th step; False where there are fewer."""
    steps = itertools.count()

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if next(steps) == k:
                if kill:
                    os._exit(9)
                raise OSError(errno.EIO, "broken")
            return real(*arguments, **options)

        return call

    def work() -> None:
        for name in ("replace", "rename", "fsync", "unlink", "rmdir"):
            setattr(os, name, counted(getattr(os, name)))
        with contextlib.suppress(OSError):
            write_folder(path, "new")
        os._exit(next(steps) > k)

    return os.waitpid(fork_and(work), 0)[1] != 0


def fork_and(work: Callable[[], object]) -> int:
    process = os.fork()
    if process == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(7)
    return process


@pytest.mark.parametrize("kill", [True, False])
@pytest.mark.parametrize("there", [True, False])
def test_whatever_step_fails_one_of_the_two_is_whole_and_the_next_call_clears_up(
    tmp_path: Path, kill: bool, there: bool
) -> None:
    met, k, goes_on = set[str](), 0, True
    while goes_on:
        folder = tmp_path / str(k) / "model"
        if there:
            write_folder(folder, "old")
        goes_on = reaches(folder, k, kill=kill)
        recover(folder)
        if there or folder.exists():
            met.update(texts(folder))
        write_folder(folder, "newest")
        assert texts(folder) == ["newest"] * 2
        assert [path.name for path in folder.parent.iterdir()] == ["model"]
        k += 1
    assert met == ({"old", "new"} if there else {"new"}) and k > (8 if there else 4)


def test_what_was_moved_aside_is_found_by_who_reads(policy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = load_policy(policy).state_dict()
    real, calls = os.rename, itertools.count()

    def rename(source: Path, target: Path) -> None:
        if next(calls) > 0:
            raise OSError(errno.EIO, "broken")  # neither the new one in nor the old one back
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", rename)
        with pytest.raises(OSError, match="broken"):
            save_policy(policy, TanhGaussianActor(3, 2, hidden=(8,)))
    assert not policy.exists()
    assert all(torch.equal(value, before[name]) for name, value in load_policy(policy).state_dict().items())
    assert [path.name for path in policy.parent.iterdir()] == ["policy"]


def test_a_folder_that_cannot_be_deleted_does_not_cost_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(path: str, *_: Any, **options: Any) -> None:
        raise PermissionError(errno.EACCES, "not allowed", path)

    folder = tmp_path / "model"
    write_folder(folder, "old")
    with monkeypatch.context() as patch:
        for name in ("unlink", "rmdir"):
            patch.setattr(os, name, never)
        write_folder(folder, "new")
        (left,) = (path for path in tmp_path.iterdir() if path != folder)
        assert (texts(folder), texts(left), left.suffix) == (["new"] * 2, ["old"] * 2, ".partial")
    write_folder(folder, "newest")
    assert list(tmp_path.iterdir()) == [folder]


def test_what_a_process_still_writes_is_left_alone(tmp_path: Path) -> None:
    with replacing(tmp_path / "file") as first:
        first.write_text("first")
        write_text(tmp_path / "file", "second")
        assert first.read_text() == "first"
    assert (tmp_path / "file").read_text() == "first"
    name = re.sub(r"-\d+-", "-{}-", first.name)
    with begun([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        left = tmp_path / name.format(child.pid)
        left.write_text("half")
        foreign = tmp_path / re.sub(r"\w+-\{\}", "ffffffff-1", name)
        foreign.write_text("half")
        write_text(tmp_path / "file", "third")
        assert left.exists() and foreign.exists()
    write_text(tmp_path / "file", "fourth")
    assert sorted(tmp_path.iterdir()) == sorted([foreign, tmp_path / "file"])


def test_two_writers_at_once_leave_one_whole_folder(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    for process in [
        fork_and(lambda name=name: [write_folder(folder, f"{name}{i}") for i in range(20)]) for name in "ab"
    ]:
        assert os.waitpid(process, 0)[1] == 0
    assert texts(folder)[0] in ("a19", "b19")
    write_folder(folder, "last")
    assert list(tmp_path.iterdir()) == [folder]


def test_symbolic_links_stay_and_what_they_lead_to_is_replaced(tmp_path: Path) -> None:
    disk, here = tmp_path / "disk", tmp_path / "here"
    here.mkdir()
    write_folder(disk / "folder", "old")
    write_text(disk / "file", "old")
    for name in ("folder", "file", "new"):
        (here / name).symlink_to(disk / name)
    (here / "again").symlink_to("folder")
    for name in ("folder", "again", "new"):
        write_folder(here / name, name)
        assert (here / name).is_symlink() and texts((here / name).resolve()) == [name] * 2
    write_text(here / "file", "new")
    assert (here / "file").is_symlink() and (disk / "file").read_text() == "new"
    (here / "circle").symlink_to("circle")
    with pytest.raises(UserError, match=r"circle: .*symbolic links"):
        write_text(here / "circle", "")
    with pytest.raises(UserError, match="folder: a folder of that name stands there"):
        write_text(here / "folder", "")
    names = [sorted(path.name for path in folder.iterdir()) for folder in (disk, here)]
    assert names == [["file", "folder", "new"], ["again", "circle", "file", "folder", "new"]]


def test_names_as_long_as_a_disk_allows_can_be_written(tmp_path: Path) -> None:
    for name in ("x" * 255, "ä" * 127, "y" * 254):
        write_folder(tmp_path / name, "old")
        write_folder(tmp_path / name, "new")
        assert texts(tmp_path / name) == ["new"] * 2
    assert len(list(tmp_path.iterdir())) == 3


def test_folders_that_nothing_can_replace_are_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in/side").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "in/side")
    for path in (".", "..", "", tmp_path / "in", "../side"):
        with pytest.raises(UserError, match="this command runs in that folder"):
            write_folder(Path(path), "new")
    with pytest.raises(UserError, match="a disk is mounted there"):
        write_folder(Path("/"), "new")
    os.mkfifo("pipe")
    with pytest.raises(UserError, match="pipe: it is neither a file nor a folder"):
        write_text("pipe", "new")
    assert [path.name for path in tmp_path.rglob("*")] == ["in", "side", "pipe"]
