"""HTTP downloads: resumed, retried, checked against a known sum, whole or absent."""

import errno
import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import requests
import urllib3
from rich.progress import DownloadColumn, TransferSpeedColumn

from envtf_lit.errors import DISK_FULL, UserError
from envtf_lit.progress import progress_bar

ATTEMPTS = 5  # connections in a row that bring nothing new, before a server is given up
TIMEOUT = (10, 60)  # seconds: to connect, between two pieces
PIECE = 1 << 16  # bytes, of which a broken connection loses the last
SLOWEST, WINDOW = 1_000, 60.0  # bytes a second that a server must send, over so many seconds
PASSING = (408, 425, 429, 500, 502, 503, 504)  # statuses worth another try


@dataclass(frozen=True)
class RemoteFile:
    """A file that never changes.

    Attributes:
        urls: where it lies, the first choice first; all serve the same bytes.
        size: bytes.
        sha256: in hexadecimal digits.
    """

    urls: tuple[str, ...]
    size: int
    sha256: str

    def matches(self, path: Path) -> bool:
        """Whether a file holds these bytes."""
        return path.stat().st_size == self.size and sha256(path) == self.sha256


def sha256(path: Path) -> str:
    """The SHA-256 sum of a file, in hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def fingerprint(path: Path) -> dict[str, Any]:
    """By which a file is known again, for a card: `bytes` and `sha256`."""
    return {"bytes": path.stat().st_size, "sha256": sha256(path)}


def fetch(remote: RemoteFile, path: Path, *, progress: bool = True, pause: float = 1.0) -> None:
    """Downloads a file.

    What a broken connection leaves is kept beside `path`, hidden, and continued: by the next attempt, by the next
    server, by the next call. A server that refuses ranges is asked for the whole again. `path` itself appears when the
    bytes are all there and their sum is right.

    Args:
        remote: the file.
        path: of the copy; an existing file is replaced.
        progress: shows a bar.
        pause: seconds before the second attempt; doubled for each one after it.

    Raises:
        UserError: no server has the file, or the disk is full; the message names every URL and what became of it.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _check_space(partial, remote.size)
        shown = (DownloadColumn(), TransferSpeedColumn())
        with progress_bar(path.name, remote.size, *shown, visible=progress) as update:
            _from_any(remote, partial, pause, lambda have, text: update(completed=have, description=text))
        os.replace(partial, path)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise UserError(
                f"No space left in {path.parent} while downloading {path.name} ({remote.size / 1e6:.0f} MB): free some "
                f"and run again; it continues from what is there."
            ) from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise UserError(f"Cannot write {path}: {error.strerror}; choose a folder you may write to.") from error
        raise


class _GivenUp(Exception):
    """A server does not have the file, or not the right one."""


Show = Callable[[int, str], None]  # bytes so far, and a line about them


def _check_space(partial: Path, size: int) -> None:
    needed = size - _have(partial)
    if shutil.disk_usage(partial.parent).free < needed:
        raise OSError(errno.ENOSPC, "No space left")


def _have(partial: Path) -> int:
    return partial.stat().st_size if partial.exists() else 0


def _from_any(remote: RemoteFile, partial: Path, pause: float, show: Show) -> None:
    failures = []
    for url in remote.urls:
        try:
            _from_one(url, remote, partial, pause, show)
            return
        except _GivenUp as reason:
            failures.append(f"{url} {reason}")
    raise UserError(f"Cannot download {remote.urls[0].rpartition('/')[2]}: {'; '.join(failures)}.")


def _from_one(url: str, remote: RemoteFile, partial: Path, pause: float, show: Show) -> None:
    """Connects until the file is whole, or too many connections in a row have brought nothing new."""
    name, idle, furthest, suspect = url.rpartition("/")[2], 0, _have(partial), False
    while True:
        begun = _have(partial)
        try:
            _connect(url, remote.size, partial, lambda have: show(have, name))
        except requests.RequestException as error:
            reason = _reason(error)
        else:
            if remote.matches(partial):
                return
            partial.unlink()
            if begun == 0 or suspect:
                raise _GivenUp("serves an altered file: its sha256 is not the known one")
            # perhaps what was there before was wrong: once more, from the start
            reason, furthest, suspect = "the sum of all parts is wrong", 0, True
        idle = 0 if _have(partial) > furthest else idle + 1
        furthest = max(furthest, _have(partial))
        if idle == ATTEMPTS:
            raise _GivenUp(f"failed {ATTEMPTS} times, at last with: {reason}")
        show(_have(partial), f"{name}: {reason}; trying again")
        time.sleep(pause * 2 ** max(idle - 1, 0))


def _connect(url: str, size: int, partial: Path, show: Callable[[int], None]) -> None:
    """One connection, which appends to the partial file or begins it anew; returns when all bytes are there.

    Raises:
        requests.RequestException: it broke, or the server asks for patience.
        _GivenUp: the server does not have the file.
    """
    have = _have(partial)
    if have == size:
        return
    if have > size:
        partial.unlink()
        have = 0
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    with _asked(url, headers) as response:
        have = _check_status(response, partial, have)
        _check_size(response, have, size)
        with partial.open("ab" if have else "wb") as stream:
            for piece in _pieces(response):
                stream.write(piece)
                show(stream.tell())
                if stream.tell() > size:
                    raise _GivenUp(f"sends more than the {size:,} bytes that are known")
    if _have(partial) < size:  # only a server that does not say how much it sends gets here
        raise requests.ConnectionError("the connection ended early")


def _asked(url: str, headers: dict[str, str]) -> requests.Response:
    """The answer, after redirects.

    Raises:
        requests.RequestException: there is none.
        _GivenUp: a redirect leads to no address.
    """
    try:
        return requests.get(url, headers=headers, stream=True, timeout=TIMEOUT)
    except requests.RequestException as error:
        if isinstance(error, ValueError):  # what an address can be wrong in
            raise _GivenUp(f"leads to what is no address ({_reason(error)})") from None
        raise
    except (ValueError, urllib3.exceptions.HTTPError) as error:  # of the address, which requests lets through
        raise _GivenUp(f"leads to what is no address ({' '.join(str(error).split())[:200]})") from None


def _pieces(response: requests.Response) -> Iterator[bytes]:
    """What comes, as soon as it comes.

    Raises:
        requests.RequestException: the connection broke.
        _GivenUp: it brings so little that the file would take days.
    """
    begin, received = time.monotonic(), 0
    while True:
        try:
            piece = response.raw.read1(PIECE)
        except urllib3.exceptions.ProtocolError as error:
            raise requests.exceptions.ChunkedEncodingError(error) from error
        except (urllib3.exceptions.HTTPError, OSError) as error:
            raise requests.ConnectionError(error) from error
        if not piece:
            return
        yield piece
        received += len(piece)
        passed = time.monotonic() - begin
        if passed > WINDOW:
            if received < SLOWEST * passed:
                raise _GivenUp(f"sends {received / passed:.3g} bytes a second, and less than {SLOWEST:,} is no use")
            begin, received = time.monotonic(), 0


def _check_status(response: requests.Response, partial: Path, have: int) -> int:
    """Where the bytes that come belong: at `have`, or at the start if the server knows no ranges."""
    status = response.status_code
    if status in PASSING:
        response.raise_for_status()
    if status == 206 and response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
        return have
    if status in (206, 416):
        partial.unlink(missing_ok=True)
        raise requests.ConnectionError(f"{status} for the rest of the file")
    if status != 200:
        raise _GivenUp(f"answers {status} {response.reason}")
    return 0


def _check_size(response: requests.Response, have: int, size: int) -> None:
    """Before the bytes come: a file of another length is another file."""
    with suppress(KeyError, ValueError):
        total = have + int(response.headers["Content-Length"])
        if total != size:
            raise _GivenUp(f"has a truncated or altered file of {total:,} bytes, where {size:,} are known")


def _reason(error: requests.RequestException) -> str:
    if error.response is not None:
        return f"{error.response.status_code} {error.response.reason}"
    if isinstance(error, requests.exceptions.ChunkedEncodingError):
        return "the connection broke"
    inner = getattr(error.args[0] if error.args else error, "reason", error)  # below urllib3's count of its retries
    return " ".join(str(inner).split())[:200]
