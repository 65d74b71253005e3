"""Files and folders that are whole or absent, whatever happens while they are written."""

import contextlib
import csv
import errno
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from envtf_lit.errors import DISK_FULL, UserError

# names of what lies beside a file or folder while it is written, and who writes it: machine, process
_MADE = re.compile(r"\.(.+)\.(\w+)-(\d+)-[0-9a-f]{8}\.(partial|old)", re.DOTALL)
_IN_USE = set[str]()  # those of this process
_LONGEST = 100  # bytes of a name that are kept in one of these; most file systems allow 255 in all
_FOREIGN = 7 * 24 * 3600.0  # seconds after which what another machine left is taken for forgotten
MOST_JSON = 32 << 20  # bytes; a horizon report, the longest that we write, has a few
_TRIES = 10  # at taking a folder's place, while others take it too


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`; on success it takes `path`'s place, on failure it is removed.

    The block creates a file or a folder, and what it replaces is of the same kind. A symbolic link stays, and what it
    leads to is replaced. A folder that is replaced is moved aside, and deleted when the new one is in its place, so
    that a process killed at any moment leaves one of the two whole: the next call puts back what it left aside, as
    `recover` does, and clears away the rest.

    Raises:
        UserError: the disk is full, the place cannot be written, a folder stands where a file shall, or a file where a
            folder shall, or what stands there cannot be replaced. What was there stays.
    """
    path, temporary = Path(path), None
    target = path
    try:
        target = _target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        _clear(target)
        temporary = _beside(target, "partial")
        _IN_USE.add(temporary.name)
        yield temporary
        if target.exists() and target.is_dir() != temporary.is_dir():
            kind = "folder" if target.is_dir() else "file"
            raise UserError(
                f"Cannot write {path}: a {kind} of that name stands there; move it, or choose another name."
            )
        _to_disk(temporary)
        _put(temporary, target)
        _clear(target)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise UserError(f"No space left while writing {path}: free some disk space and run again.") from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise UserError(f"Cannot write {path}: {error.strerror}; choose a folder you may write to.") from error
        if temporary is None or _names(error, path, target, temporary):
            blocker = next((parent for parent in path.parents if parent.is_file()), None)
            reason = f"{blocker} is a file, not a folder" if blocker else error.strerror
            raise UserError(f"Cannot write {path}: {reason}; choose another place.") from error
        raise
    finally:
        if temporary is not None:
            _delete(temporary)
            _IN_USE.discard(temporary.name)


def recover(path: str | Path) -> None:
    """Puts a folder back that a killed process had moved aside and not yet replaced; does nothing to one that is there.

    Whoever reads a folder that `replacing` writes calls this first. Where it cannot be done the folder stays missing.
    """
    target = Path(os.path.realpath(path))
    if os.path.lexists(target):
        return
    aside = [left for left, name in _leftovers(target) if name[4] == "old" and name[1] == _stem(target)]
    with contextlib.suppress(OSError):
        if aside:
            os.rename(max(aside, key=lambda left: left.lstat().st_ctime), target)


def _target(path: Path) -> Path:
    """What is replaced: `path`, or what a symbolic link leads to.

    Raises:
        UserError: it is no file and no folder, or a folder that cannot be exchanged for another.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) or path.name in ("", "..") else path
    try:
        mode = os.stat(target).st_mode
    except FileNotFoundError:
        return target
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UserError(f"Cannot write {path}: it is neither a file nor a folder; choose another name.")
    if os.path.ismount(target):
        raise UserError(f"Cannot write {path}: a disk is mounted there, which nothing replaces; choose a folder in it.")
    if stat.S_ISDIR(mode) and Path.cwd().is_relative_to(target.resolve()):
        raise UserError(f"Cannot write {path}: this command runs in that folder; choose another name.")
    return target


def _put(temporary: Path, target: Path) -> None:
    """Moves what is whole to its place; what stood there is in it again if that fails."""
    if not temporary.is_dir():
        os.replace(temporary, target)
        return
    for left in range(_TRIES - 1, -1, -1):
        aside = _beside(target, "old")
        try:
            with contextlib.suppress(FileNotFoundError):  # there is none
                os.rename(target, aside)
            os.rename(temporary, target)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.rename(aside, target)
            if left and isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # another process was quicker
            raise
        break


def _clear(target: Path) -> None:
    """Puts back what was moved aside for nothing, and deletes what killed processes left beside `target`."""
    recover(target)
    for left, name in _leftovers(target):
        if not _is_in_use(left, name) and (name[4] == "partial" or os.path.lexists(target)):
            _delete(left, target)


def _leftovers(target: Path) -> list[tuple[Path, re.Match[str]]]:
    """What lies beside `target` under names of `_beside`, or of `_beside` such a name."""
    found, stem = [], _stem(target)
    with contextlib.suppress(OSError), os.scandir(target.parent) as entries:
        for entry in entries:
            name = inner = _MADE.fullmatch(entry.name)
            while inner is not None and inner[1] != stem:
                inner = _MADE.fullmatch(inner[1])
            if name is not None and inner is not None:
                found.append((target.with_name(entry.name), name))
    return found


def _is_in_use(left: Path, name: re.Match[str]) -> bool:
    """Whether the process that made it may still need it."""
    if name[2] != _machine():
        with contextlib.suppress(OSError):
            return time.time() - left.lstat().st_ctime < _FOREIGN
        return True
    if int(name[3]) == os.getpid():
        return left.name in _IN_USE
    try:
        os.kill(int(name[3]), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _beside(target: Path, kind: str) -> Path:
    return target.with_name(f".{_stem(target)}.{_machine()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.{kind}")


def _stem(target: Path) -> str:
    """The name; of a long one the beginning and a digest, so that there is room for more."""
    encoded = os.fsencode(target.name)
    if len(encoded) <= _LONGEST:
        return target.name
    return f"{target.name[:20]}~{hashlib.blake2b(encoded, digest_size=8).hexdigest()}"


@functools.cache
def _machine() -> str:
    """Where process numbers mean the same: a host, or a container on it."""
    space = ""
    with contextlib.suppress(OSError):  # elsewhere than on Linux
        space = os.readlink("/proc/self/ns/pid")
    return hashlib.blake2b(f"{platform.node()} {space}".encode(), digest_size=4).hexdigest()


def _delete(path: Path, target: Path | None = None) -> None:
    """Deletes as much as can be; a folder that was moved aside for `target` first loses the name it would return by."""
    with contextlib.suppress(OSError):
        if target is not None and path.name.endswith(".old"):
            path = path.rename(_beside(target, "partial"))
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _to_disk(path: Path) -> None:
    """Waits until a file, or a folder and what is in it, would survive a power cut."""
    inside = [Path(folder, name) for folder, _, names in os.walk(path) for name in (*names, "")]
    for one in inside or [path]:
        if one.is_symlink():
            continue
        handle = os.open(one, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that do not know the wish
                raise
        finally:
            os.close(handle)


def _names(error: OSError, path: Path, target: Path, temporary: Path) -> bool:
    """Whether the place is to blame, rather than something else that was read or written meanwhile."""
    if not isinstance(error.filename, str | os.PathLike):
        return False
    return Path(error.filename) in (path, target) or temporary.is_relative_to(error.filename)


class _Rehearsed(Exception):
    """Ends a rehearsal."""


def check_writable(path: str | Path, *, folder: bool) -> None:
    """Tests before long work that `replacing` will be able to put a folder, or a file, there.

    Raises:
        UserError: it will not.
    """
    path = Path(path)
    if os.path.lexists(path) and path.is_dir() != folder:
        kind = "folder" if path.is_dir() else "file" if path.exists() else "link to nowhere"
        raise UserError(f"Cannot write {path}: a {kind} of that name stands there; move it, or choose another name.")
    with contextlib.suppress(_Rehearsed), replacing(path) as temporary:
        if folder:
            temporary.mkdir()
        else:
            temporary.touch()
        raise _Rehearsed


def write_text(path: str | Path, text: str) -> None:
    """Writes a whole text or nothing; raises what `replacing` does."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_json(path: str | Path, content: Any) -> None:
    """Writes finite numbers, strings, lists and dictionaries; NaN and infinity raise ValueError."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def check_plain(path: str | Path, most: int | None = None) -> None:
    """Refuses what would block who reads it, or never end: a pipe, a device, a text far longer than ours are.

    Args:
        path: of the file.
        most: bytes; None for any number.

    Raises:
        UserError: it is no file, or a longer one.
        FileNotFoundError: there is none.
    """
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        raise UserError(f"{path} is not a file, but a folder, a pipe or a device: give a file.")
    if most is not None and found.st_size > most:
        raise UserError(f"{path} has {found.st_size:,} bytes, and such a file has at most {most:,}: give another one.")


def read_json(path: str | Path) -> Any:
    """Reads a JSON file.

    Raises:
        UserError: the file is missing, is not JSON, or has more than `MOST_JSON` bytes.
    """
    path = Path(path)
    try:
        check_plain(path, MOST_JSON)
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: check the path, or run the stage that writes it.") from None
    except UserError:
        raise
    except (ValueError, RecursionError) as error:  # the latter of brackets in brackets, the former of a long number too
        raise UserError(f"{path} is not valid JSON ({error}): write it anew.") from None


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV, whole or not at all; what a row lacks is left empty."""
    names = dict.fromkeys(name for row in rows for name in row)
    with replacing(path) as temporary, temporary.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)
