"""A web server on this machine that misbehaves as it is told."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Server:
    """What it does, and what it was asked.

    Attributes:
        content: what it serves.
        drop: connections, from the first one on, that break after so many bytes of their answer.
        statuses: answers to the first requests, before any content.
        ranges: whether it knows them.
        declares: whether it says how much it sends.
        redirect: where every request is sent on to.
        pause: seconds after each byte.
        asked: each request's Range header.
    """

    content: bytes
    drop: list[int] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)
    ranges: bool = True
    declares: bool = True
    redirect: str | None = None
    pause: float = 0.0
    asked: list[str | None] = field(default_factory=list)
    url: str = ""


def _handler(server: Server) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = self.headers.get("Range")
            server.asked.append(asked)
            if server.statuses:
                self.send_error(server.statuses.pop(0))
                return
            if server.redirect is not None:
                self.send_response(302)
                self.send_header("Location", server.redirect)
                self.end_headers()
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
            for byte in body if server.pause else b"":
                self.wfile.write(bytes([byte]))
                time.sleep(server.pause)
            self.wfile.write(body[: server.drop.pop(0)] if server.drop else body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


class _Patient(ThreadingHTTPServer):
    def handle_error(self, request: object, client_address: object) -> None:
        """Clients that have seen enough hang up, which is no news."""


@contextmanager
def serving(server: Server) -> Iterator[Server]:
    """Runs it, and fills in its `url`."""
    with _Patient(("127.0.0.1", 0), _handler(server)) as http:
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        server.url = f"http://127.0.0.1:{http.server_port}/some.hdf5"
        try:
            yield server
        finally:
            http.shutdown()
