"""Minari datasets from a remote: Hugging Face's own client against a stand-in for its server on this machine."""

import hashlib
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import huggingface_hub.constants
import pytest
from logs import dataset_of_chains

from envtf_lit.data.sources.minari import read_minari, write_minari
from envtf_lit.errors import UserError

pytestmark = pytest.mark.usefixtures("minari_root")


@dataclass
class Hub:
    """As much of a Hugging Face remote as its client asks for.

    Attributes:
        files: content by path inside the one repository, `farama-minari/ours`.
        asked: paths that were fetched.
    """

    files: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)

    def answer(self, path: str) -> bytes | None:
        if path.startswith("/api/datasets?") and self.files:
            return json.dumps([{"_id": "0" * 24, "id": "farama-minari/ours"}]).encode()
        if path.startswith("/api/datasets/farama-minari/ours/tree/"):
            tree = [{"type": "file", "path": k, "size": len(v), "oid": SHA} for k, v in self.files.items()]
            return json.dumps(tree).encode()
        if path.startswith("/api/datasets/farama-minari/ours/"):
            return json.dumps({"_id": "0" * 24, "id": "farama-minari/ours", "sha": SHA, "siblings": []}).encode()
        name = path.partition(f"/resolve/{SHA if SHA in path else 'main'}/")[2]
        self.asked.append(name)
        return self.files.get(name)


SHA = "a" * 40


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """A remote on this machine that knows no dataset, until a test gives it some."""
    remote = Hub()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = remote.answer(self.path)
            self.send_response(404 if content is None else 200)
            if content is None and "/resolve/" in self.path:
                self.send_header("X-Error-Code", "EntryNotFound")
            self.send_header("Content-Length", str(len(content or b"")))
            self.send_header("X-Repo-Commit", SHA)
            self.send_header("ETag", f'"{hashlib.sha1(content or b"").hexdigest()}"')
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content or b"")

        do_HEAD = do_GET

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", url)
        monkeypatch.setattr(
            huggingface_hub.constants, "HUGGINGFACE_CO_URL_TEMPLATE", url + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        yield remote
        server.shutdown()


@pytest.mark.usefixtures("hub")
def test_a_remote_that_fails_is_named_with_a_way_out(minari_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"Cannot fetch the Minari dataset mujoco/hopper/medium-v0 .*404.* copy its"):
        read_minari("mujoco/hopper/medium-v0", download=True)
    assert capsys.readouterr().out == ""
    assert list(minari_root.rglob("metadata.json")) == []


def test_a_dataset_that_is_here_is_not_fetched(hub: Hub) -> None:
    write_minari(dataset_of_chains(), "plain-v0")
    assert len(read_minari("plain-v0", download=True)) == 9
    assert hub.asked == []


@pytest.mark.parametrize("left", [False, True])
def test_a_remote_dataset_is_fetched_even_where_a_download_broke(
    minari_root: Path, tmp_path: Path, hub: Hub, left: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    write_minari(dataset_of_chains(), "ours/plain-v0", root=tmp_path / "elsewhere")
    source = tmp_path / "elsewhere/ours"
    hub.files = {str(path.relative_to(source)): path.read_bytes() for path in source.rglob("*") if path.is_file()}
    hub.files["namespace_metadata.json"] = json.dumps({"datasets": ["ours/plain-v0"]}).encode()
    if left:  # what minari itself would take for the dataset
        (minari_root / "ours/plain-v0/data").mkdir(parents=True)
        (minari_root / "ours/plain-v0/data/metadata.json").write_bytes(hub.files["plain-v0/data/metadata.json"])
    assert len(read_minari("ours/plain-v0", download=True)) == 9
    assert "plain-v0/data/main_data.hdf5" in hub.asked
    assert capsys.readouterr().out == ""
