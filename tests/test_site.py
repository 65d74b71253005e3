"""The documentation site: it builds without a warning, fetches nothing, and works in a browser (where there is one)."""

import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = ("index", "algorithms/mopo", "metrics", "api/world_models")
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    pytest.importorskip("sphinx", reason="needs the extra docs")
    out = tmp_path_factory.mktemp("site")
    options = ["--quiet", "--fail-on-warning", "--keep-going", "--doctree-dir", str(out / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(out / "html")]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return out / "html"


class Quiet(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served; the search fetches pages, which browsers allow no file to do."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def shown(page: str, width: int = 1280) -> tuple[str, str]:
    """What a page has become after its scripts ran, and what the browser's console says of it."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900", "--virtual-time-budget=20000"]
    assert BROWSER is not None
    command = [BROWSER, *flags, "--enable-logging=stderr", "--dump-dom", page]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if ":CONSOLE" in line)


def test_no_page_fetches_anything(site: Path) -> None:
    fetched = re.compile(r"<(?:script|img|iframe|link)\b[^>]*(?:src|href)=\"(?:https?:)?//[^>]*>")
    pages = list(site.rglob("*.html"))
    assert len(pages) > 50
    assert {str(page): found for page in pages if (found := fetched.findall(page.read_text()))} == {}
    assert (site / "_static/mathjax/tex-chtml.js").is_file()


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize("name", PAGES)
def test_pages_show_their_formulas_and_the_console_stays_silent(address: str, name: str) -> None:
    page, console = shown(f"{address}/{name}.html")
    assert console == ""
    assert "<mjx-merror" not in page
    assert ("<mjx-container" in page) == (name == "algorithms/mopo")


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_search_finds_mopo(address: str) -> None:
    page, console = shown(f"{address}/search.html?q=MOPO")
    assert console == ""
    assert 'href="algorithms/mopo.html' in page
