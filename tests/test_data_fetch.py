"""The downloader against a real server on this machine that misbehaves in every way we know of."""

import errno
import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from web import Server, serving

from envtf_lit.data.sources.fetch import ATTEMPTS, PIECE, RemoteFile, fetch
from envtf_lit.errors import UserError

P = PIECE  # connections break between two pieces, so that the tests can count
CONTENT = np.random.default_rng(0).bytes(3_000_000)
ALTERED = CONTENT[:1000] + b"x" + CONTENT[1001:]


def server(content: bytes = CONTENT, **behaviour: Any) -> Server:
    return Server(content, **behaviour)


def remote(*servers: Server) -> RemoteFile:
    """Of the right bytes, whatever the servers hold."""
    return RemoteFile(tuple(s.url for s in servers), len(CONTENT), hashlib.sha256(CONTENT).hexdigest())


@pytest.fixture
def serve() -> Iterator[Callable[[Server], Server]]:
    """Starts servers, and stops them after the test."""
    with ExitStack() as stack:
        yield lambda server: stack.enter_context(serving(server))


Serve = Callable[[Server], Server]


def get(remote: RemoteFile, path: Path) -> None:
    fetch(remote, path, progress=False, pause=0.001)


# what goes well in the end


def test_a_plain_download(serve: Serve, tmp_path: Path) -> None:
    here = serve(server())
    get(remote(here), tmp_path / "new/folder/some.hdf5")
    assert (tmp_path / "new/folder/some.hdf5").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "new/folder").iterdir()] == ["some.hdf5"]
    assert here.asked == [None]


@pytest.mark.parametrize("declares", [True, False])
def test_broken_connections_are_continued_where_they_broke(serve: Serve, tmp_path: Path, declares: bool) -> None:
    drops = [10 * P] + [P] * (ATTEMPTS + 3)  # more than may fail in a row: each brings something
    here = serve(server(drop=[*drops], declares=declares))
    get(remote(here), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert here.asked == [None] + [f"bytes={(10 + i) * P}-" for i in range(len(drops))]


def test_a_server_without_ranges_is_asked_for_the_whole_again(serve: Serve, tmp_path: Path) -> None:
    here = serve(server(drop=[10 * P, 5 * P], ranges=False))
    get(remote(here), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert here.asked == [None, f"bytes={10 * P}-", f"bytes={5 * P}-"]


@pytest.mark.parametrize("status", [500, 503, 429])
def test_a_server_in_trouble_is_asked_again(serve: Serve, tmp_path: Path, status: int) -> None:
    here = serve(server(statuses=[status] * (ATTEMPTS - 1)))
    get(remote(here), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert len(here.asked) == ATTEMPTS


def test_the_next_call_continues_what_an_interrupted_one_left(serve: Serve, tmp_path: Path) -> None:
    here = serve(server(drop=[10 * P]))
    whole = remote(here)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("envtf_lit.data.sources.fetch.time.sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            get(whole, tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()
    get(whole, tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert here.asked == [None, f"bytes={10 * P}-"]


def test_a_second_server_continues_for_the_first(serve: Serve, tmp_path: Path) -> None:
    first, second = serve(server(drop=[10 * P] + [0] * ATTEMPTS)), serve(server())
    get(remote(first, second), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert second.asked == [f"bytes={10 * P}-"]


@pytest.mark.parametrize("left", [ALTERED[:2_000_000], CONTENT + b"more", ALTERED])
def test_a_wrong_left_over_is_replaced(serve: Serve, tmp_path: Path, left: bytes) -> None:
    here = serve(server())
    (tmp_path / ".some.hdf5.partial").write_bytes(left)
    get(remote(here), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert here.asked[-1] is None


# what does not


@pytest.mark.parametrize(("status", "name"), [(403, "Forbidden"), (404, "Not Found"), (410, "Gone")])
def test_a_refusal_is_not_asked_twice(serve: Serve, tmp_path: Path, status: int, name: str) -> None:
    here = serve(server(statuses=[status] * 9))
    with pytest.raises(UserError, match=rf"Cannot download some.hdf5: {here.url} answers {status} {name}"):
        get(remote(here), tmp_path / "some.hdf5")
    assert len(here.asked) == 1
    assert list(tmp_path.iterdir()) == []


def test_trouble_that_lasts_ends(serve: Serve, tmp_path: Path) -> None:
    here = serve(server(statuses=[500] * 99))
    with pytest.raises(UserError, match=r"failed 5 times, at last with: 500 Internal Server Error"):
        get(remote(here), tmp_path / "some.hdf5")
    assert len(here.asked) == ATTEMPTS


def test_a_connection_that_always_breaks_at_the_same_place_ends(serve: Serve, tmp_path: Path) -> None:
    here = serve(server(drop=[5 * P] * 99, ranges=False))
    with pytest.raises(UserError, match="failed 5 times"):
        get(remote(here), tmp_path / "some.hdf5")
    assert len(here.asked) == 1 + ATTEMPTS


@pytest.mark.parametrize(
    "address",
    [
        *("http://[::1", "http://a..b/x", "http:///x", "ftp://127.0.0.1/x", "http://127.0.0.1:99999/x", "http://*x/"),
        *("\u00ff:", f"http://{'a' * 300}/x", "file:///etc/passwd", "http://127.0.0.1:9x/"),
    ],
)
def test_a_redirect_to_what_is_no_address_ends(serve: Serve, tmp_path: Path, address: str) -> None:
    here = serve(server(redirect=address))
    with pytest.raises(UserError, match=r"^Cannot download some\.hdf5: http://127\.0\.0\.1:\d+/some\.hdf5 \S+ "):
        get(remote(here), tmp_path / "some.hdf5")
    assert list(tmp_path.iterdir()) == []


def test_a_server_that_drips_is_given_up_and_the_next_one_continues(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("envtf_lit.data.sources.fetch.WINDOW", 0.2)
    drips, sound = serve(server(pause=0.02)), serve(server())
    with pytest.raises(UserError, match=r"sends \d+(\.\d+)? bytes a second, and less than 1,000 is no use"):
        get(remote(drips), tmp_path / "some.hdf5")
    get(remote(drips, sound), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    (asked,) = sound.asked
    assert asked is not None and 0 < int(asked.removeprefix("bytes=").removesuffix("-")) < 200


def test_nobody_answers(tmp_path: Path) -> None:
    whole = RemoteFile(("http://127.0.0.1:9/some.hdf5",), 1, "")
    with pytest.raises(UserError, match=r"http://127.0.0.1:9/some.hdf5 failed 5 times, at last with: "):
        get(whole, tmp_path / "some.hdf5")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (server(content=CONTENT[:-1]), "has a truncated or altered file of 2,999,999 bytes, where 3,000,000 are known"),
        (server(content=CONTENT + b"x"), "has a truncated or altered file of 3,000,001 bytes"),
        (server(content=CONTENT + b"x" * 3_000_000, declares=False), "sends more than the 3,000,000 bytes"),
        (server(content=CONTENT[:-1], declares=False), "failed 5 times|truncated"),
        (server(content=ALTERED), "serves an altered file: its sha256"),
        (server(content=ALTERED, drop=[9 * P] * 9), "serves an altered file: its sha256"),
    ],
)
def test_another_file_is_refused(serve: Serve, tmp_path: Path, other: Server, message: str) -> None:
    here = serve(other)
    with pytest.raises(UserError, match=message):
        get(remote(here), tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()


def test_every_server_is_named(serve: Serve, tmp_path: Path) -> None:
    first, second = serve(server(statuses=[403])), serve(server(statuses=[404]))
    with pytest.raises(UserError) as error:
        get(remote(first, second), tmp_path / "some.hdf5")
    assert f"{first.url} answers 403 Forbidden; {second.url} answers 404 Not Found" in str(error.value)


def test_a_full_disk_is_seen_before_the_download(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = serve(server())
    monkeypatch.setattr(
        "envtf_lit.data.sources.fetch.shutil.disk_usage", lambda _: type("Usage", (), {"free": 2_999_999})
    )
    with pytest.raises(UserError, match=r"No space left in .* while downloading some.hdf5 \(3 MB\)"):
        get(remote(here), tmp_path / "some.hdf5")
    assert here.asked == []


def test_a_disk_that_fills_up(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("envtf_lit.data.sources.fetch.os.replace", full)
    with pytest.raises(UserError, match="No space left"):
        get(remote(serve(server())), tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()
