"""A small Hugging Face hub on this machine: repositories in memory, and the ways in which a real one fails."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

COMMIT = "0" * 39 + "1"


@dataclass
class Hub:
    """What it holds, and how it fails.

    Attributes:
        files: by repository and name.
        status: of every answer, where it is not 0.
        half: of this file, or of the `facts` of a repository, only the first half comes, though the whole is announced.
        stated: sizes that it lies about.
        token: that it wants, where it is not empty.
        commits: repositories that were written to.
    """

    files: dict[str, dict[str, bytes]] = field(default_factory=dict)
    status: int = 0
    half: str = ""
    stated: dict[str, int] = field(default_factory=dict)
    token: str = ""
    commits: list[str] = field(default_factory=list)
    url: str = ""


def _handler(hub: Hub) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path = self.path.partition("?")[0].strip("/").split("/")
            if self._refused():
                return
            if path[:2] == ["api", "models"]:
                self._facts("/".join(path[2:4]))
            else:
                repository, name = "/".join(path[:2]), "/".join(path[4:])
                content = hub.files.get(repository, {}).get(name)
                if content is None:
                    self.send_error(404)
                else:
                    self._send(content, half=name == hub.half)

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            path = self.path.partition("?")[0].strip("/").split("/")
            if self._refused():
                return
            if path[-2:] == ["repos", "create"]:
                asked = json.loads(body)
                name = (
                    f"{asked['organization']}/{asked['name']}" if asked.get("organization") else f"me/{asked['name']}"
                )
                hub.files.setdefault(name, {})
                self._json({"url": f"{hub.url}/{name}"})
            elif "preupload" in path:
                names = [file["path"] for file in json.loads(body)["files"]]
                self._json({"files": [{"path": n, "uploadMode": "regular", "shouldIgnore": False} for n in names]})
            elif "commit" in path:
                repository = "/".join(path[2:4])
                for line in map(json.loads, body.splitlines()):
                    if line["key"] == "file":
                        value = line["value"]
                        hub.files[repository][value["path"]] = base64.b64decode(value["content"])
                hub.commits.append(repository)
                self._json({"commitUrl": f"{hub.url}/{repository}/commit/{COMMIT}", "commitOid": COMMIT})
            else:  # of a card's front matter
                self._json({"errors": [], "warnings": []})

        def _refused(self) -> bool:
            if hub.status:
                self.send_error(hub.status)
            elif hub.token and self.headers.get("Authorization") != f"Bearer {hub.token}":
                self.send_error(401)
            else:
                return False
            return True

        def _facts(self, repository: str) -> None:
            if repository not in hub.files:
                self.send_error(404)
                return
            rows: list[dict[str, Any]] = []
            for name, content in hub.files[repository].items():
                row: dict[str, Any] = {"rfilename": name, "size": hub.stated.get(name, len(content))}
                if name.endswith(".safetensors"):
                    row["lfs"] = {"sha256": hashlib.sha256(content).hexdigest(), "size": row["size"]}
                rows.append(row)
            self._json({"id": repository, "sha": COMMIT, "siblings": rows}, half=hub.half == "facts")

        def _json(self, content: Any, *, half: bool = False) -> None:
            self._send(json.dumps(content).encode(), half=half)

        def _send(self, content: bytes, *, half: bool = False) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2] if half else content)
            self.close_connection = half

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


@contextmanager
def running(hub: Hub) -> Iterator[Hub]:
    """Runs it, and fills in its `url`."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _handler(hub)) as http:
        http.daemon_threads = True
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        hub.url = f"http://127.0.0.1:{http.server_port}"
        try:
            yield hub
        finally:
            http.shutdown()
