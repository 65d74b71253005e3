"""The downloader against a real server on this machine that misbehaves in every way we know of."""

import errno
import hashlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from envtf_lit.data.fetch import ATTEMPTS, PIECE, RemoteFile, fetch
from envtf_lit.errors import UserError

P = PIECE  # connections break between two pieces, so that the tests can count
CONTENT = np.random.default_rng(0).bytes(3_000_000)
ALTERED = CONTENT[:1000] + b"x" + CONTENT[1001:]


@dataclass
class Server:
    """What it does, and what it was asked.

    Attributes:
        content: what it serves.
        drop: connections, from the first one on, that break after so many bytes of their answer.
        statuses: answers to the first requests, before any content.
        ranges: whether it knows them.
        declares: whether it says how much it sends.
        asked: each request's Range header.
    """

    content: bytes = CONTENT
    drop: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    ranges: bool = True
    declares: bool = True
    asked: list[str | None] = field(default_factory=list)
    url: str = ""

    def remote(self, *more: str) -> RemoteFile:
        return RemoteFile((self.url, *more), len(CONTENT), hashlib.sha256(CONTENT).hexdigest())


def handler(server: Server) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = self.headers.get("Range")
            server.asked.append(asked)
            if server.statuses:
                self.send_error(server.statuses.pop(0))
                return
            begin = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and server.ranges else 0
            if begin >= len(server.content):
                self.send_error(416)
                return
            body = server.content[begin:]
            self.send_response(206 if begin else 200)
            if begin:
                self.send_header("Content-Range", f"bytes {begin}-{len(server.content) - 1}/{len(server.content)}")
            if server.declares:
                self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body[: server.drop.pop(0)] if server.drop else body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


@pytest.fixture
def serve() -> Iterator[Callable[[Server], Server]]:
    """Starts servers, and stops them after the test."""
    running = []

    def start(server: Server) -> Server:
        http = ThreadingHTTPServer(("127.0.0.1", 0), handler(server))
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        running.append(http)
        server.url = f"http://127.0.0.1:{http.server_port}/some.hdf5"
        return server

    yield start
    for http in running:
        http.shutdown()
        http.server_close()


Serve = Callable[[Server], Server]


def get(remote: RemoteFile, path: Path) -> None:
    fetch(remote, path, progress=False, pause=0.001)


# what goes well in the end


def test_a_plain_download(serve: Serve, tmp_path: Path) -> None:
    server = serve(Server())
    get(server.remote(), tmp_path / "new/folder/some.hdf5")
    assert (tmp_path / "new/folder/some.hdf5").read_bytes() == CONTENT
    assert [path.name for path in (tmp_path / "new/folder").iterdir()] == ["some.hdf5"]
    assert server.asked == [None]


@pytest.mark.parametrize("declares", [True, False])
def test_broken_connections_are_continued_where_they_broke(serve: Serve, tmp_path: Path, declares: bool) -> None:
    drops = [10 * P] + [P] * (ATTEMPTS + 3)  # more than may fail in a row: each brings something
    server = serve(Server(drop=[*drops], declares=declares))
    get(server.remote(), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert server.asked == [None] + [f"bytes={(10 + i) * P}-" for i in range(len(drops))]


def test_a_server_without_ranges_is_asked_for_the_whole_again(serve: Serve, tmp_path: Path) -> None:
    server = serve(Server(drop=[10 * P, 5 * P], ranges=False))
    get(server.remote(), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert server.asked == [None, f"bytes={10 * P}-", f"bytes={5 * P}-"]


@pytest.mark.parametrize("status", [500, 503, 429])
def test_a_server_in_trouble_is_asked_again(serve: Serve, tmp_path: Path, status: int) -> None:
    server = serve(Server(statuses=[status] * (ATTEMPTS - 1)))
    get(server.remote(), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert len(server.asked) == ATTEMPTS


def test_the_next_call_continues_what_an_interrupted_one_left(serve: Serve, tmp_path: Path) -> None:
    server = serve(Server(drop=[10 * P]))
    remote = server.remote()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("envtf_lit.data.fetch.time.sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            get(remote, tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()
    get(remote, tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert server.asked == [None, f"bytes={10 * P}-"]


def test_a_second_server_continues_for_the_first(serve: Serve, tmp_path: Path) -> None:
    first, second = serve(Server(drop=[10 * P] + [0] * ATTEMPTS)), serve(Server())
    get(first.remote(second.url), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert second.asked == [f"bytes={10 * P}-"]


@pytest.mark.parametrize("left", [ALTERED[:2_000_000], CONTENT + b"more", ALTERED])
def test_a_wrong_left_over_is_replaced(serve: Serve, tmp_path: Path, left: bytes) -> None:
    server = serve(Server())
    (tmp_path / ".some.hdf5.partial").write_bytes(left)
    get(server.remote(), tmp_path / "some.hdf5")
    assert (tmp_path / "some.hdf5").read_bytes() == CONTENT
    assert server.asked[-1] is None


# what does not


@pytest.mark.parametrize(("status", "name"), [(403, "Forbidden"), (404, "Not Found"), (410, "Gone")])
def test_a_refusal_is_not_asked_twice(serve: Serve, tmp_path: Path, status: int, name: str) -> None:
    server = serve(Server(statuses=[status] * 9))
    with pytest.raises(UserError, match=rf"Cannot download some.hdf5: {server.url} answers {status} {name}"):
        get(server.remote(), tmp_path / "some.hdf5")
    assert len(server.asked) == 1
    assert list(tmp_path.iterdir()) == []


def test_trouble_that_lasts_ends(serve: Serve, tmp_path: Path) -> None:
    server = serve(Server(statuses=[500] * 99))
    with pytest.raises(UserError, match=r"failed 5 times, at last with: 500 Internal Server Error"):
        get(server.remote(), tmp_path / "some.hdf5")
    assert len(server.asked) == ATTEMPTS


def test_a_connection_that_always_breaks_at_the_same_place_ends(serve: Serve, tmp_path: Path) -> None:
    server = serve(Server(drop=[5 * P] * 99, ranges=False))
    with pytest.raises(UserError, match="failed 5 times"):
        get(server.remote(), tmp_path / "some.hdf5")
    assert len(server.asked) == 1 + ATTEMPTS


def test_nobody_answers(tmp_path: Path) -> None:
    remote = RemoteFile(("http://127.0.0.1:9/some.hdf5",), 1, "")
    with pytest.raises(UserError, match=r"http://127.0.0.1:9/some.hdf5 failed 5 times, at last with: "):
        get(remote, tmp_path / "some.hdf5")


@pytest.mark.parametrize(
    ("server", "message"),
    [
        (Server(content=CONTENT[:-1]), "has a truncated or altered file of 2,999,999 bytes, where 3,000,000 are known"),
        (Server(content=CONTENT + b"x"), "has a truncated or altered file of 3,000,001 bytes"),
        (Server(content=CONTENT + b"x" * 3_000_000, declares=False), "sends more than the 3,000,000 bytes"),
        (Server(content=CONTENT[:-1], declares=False), "failed 5 times|truncated"),
        (Server(content=ALTERED), "serves an altered file: its sha256"),
        (Server(content=ALTERED, drop=[9 * P] * 9), "serves an altered file: its sha256"),
    ],
)
def test_another_file_is_refused(serve: Serve, tmp_path: Path, server: Server, message: str) -> None:
    serve(server)
    with pytest.raises(UserError, match=message):
        get(server.remote(), tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()


def test_every_server_is_named(serve: Serve, tmp_path: Path) -> None:
    first, second = serve(Server(statuses=[403])), serve(Server(statuses=[404]))
    with pytest.raises(UserError) as error:
        get(first.remote(second.url), tmp_path / "some.hdf5")
    assert f"{first.url} answers 403 Forbidden; {second.url} answers 404 Not Found" in str(error.value)


def test_a_full_disk_is_seen_before_the_download(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = serve(Server())
    monkeypatch.setattr("envtf_lit.data.fetch.shutil.disk_usage", lambda _: type("Usage", (), {"free": 2_999_999}))
    with pytest.raises(UserError, match=r"No space left in .* while downloading some.hdf5 \(3 MB\)"):
        get(server.remote(), tmp_path / "some.hdf5")
    assert server.asked == []


def test_a_disk_that_fills_up(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("envtf_lit.data.fetch.os.replace", full)
    with pytest.raises(UserError, match="No space left"):
        get(serve(Server()).remote(), tmp_path / "some.hdf5")
    assert not (tmp_path / "some.hdf5").exists()
