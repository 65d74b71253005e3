"""The pages in docs/: their links hold, a reader comes to each from the README, and what they suggest can be done."""

import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from envtf_lit.pipeline.yaml import dump_params, load_params

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
SITE_FRONT = DOCS / "index.md"  # that includes the README
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(set(DOCS.rglob("*.md")) - {SITE_FRONT})]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def links(page: Path) -> list[tuple[Path, str]]:
    """File and heading of each link within the project; the heading is empty where a link names none."""
    found = [link.partition("#") for link in LINK.findall(page.read_text()) if "://" not in link]
    return [((page.parent / path).resolve() if path else page, heading) for path, _, heading in found]


def headings(page: Path) -> set[str]:
    """A page's headings as GitHub makes links of them."""
    texts = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in texts}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    broken = [(path, heading) for path, heading in links(page) if not path.exists()]
    assert broken == []
    assert [(path, heading) for path, heading in links(page) if heading and heading not in headings(path)] == []


def test_every_page_is_reached_from_the_readme() -> None:
    reached, waiting = set[Path](), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page not in reached and page.suffix == ".md":
            reached.add(page)
            waiting += [path for path, _ in links(page)]
    assert set(PAGES) - reached == set()


def test_the_index_names_every_page_beside_it() -> None:
    listed = {path for path, _ in links(DOCS / "README.md")}
    beside = {*DOCS.glob("*.md"), *DOCS.glob("*/README.md"), DOCS / "api/index.rst"}
    assert beside - listed == {DOCS / "README.md", SITE_FRONT}


def test_pages_link_to_no_front_page() -> None:
    """The folder's README is part of the site's front page, and none of the site's own."""
    fronts = (DOCS / "README.md", SITE_FRONT)
    assert [page.name for page in PAGES[2:] for path, _ in links(page) if path in fronts] == []


def test_addresses_elsewhere_are_whole() -> None:
    found = [link for page in PAGES for link in LINK.findall(page.read_text()) if "://" in link]
    assert found
    odd = [link for link in found if not re.fullmatch(r"https://[\w-]+(\.[\w-]+)+(/[\w./?=&%+~#-]*)?", link)]
    assert odd == []


def test_every_module_of_a_room_in_the_api_reference_is_there() -> None:
    pages = {
        path.stem: re.findall(r"automodule:: envtf_lit\.(\S+)", path.read_text()) for path in DOCS.glob("api/*.rst")
    }
    documented = [name for names in pages.values() for name in names]
    rooms = [ROOT / "envtf_lit" / name for name in pages if (ROOT / "envtf_lit" / name).is_dir()]
    modules = {
        ".".join(path.relative_to(ROOT / "envtf_lit").with_suffix("").parts)
        for room in rooms
        for path in room.rglob("*.py")
    }
    assert len(rooms) > 8
    assert {name for name in modules if not name.endswith("__init__")} - set(documented) == set()
    assert len(documented) == len(set(documented))


def test_the_readme_has_a_line_for_every_room_of_the_package() -> None:
    named = re.findall(r"^  (\w+)/ +\w", (ROOT / "README.md").read_text(), re.MULTILINE)
    rooms = {path.parent.name for path in (ROOT / "envtf_lit").glob("*/__init__.py")}
    assert len(named) == len(set(named))
    assert set(named) == rooms


# What pages and notebooks suggest to write into params.yaml, or to put behind `-S` or `--`. The log tells of the past.

SOURCES = [page for page in PAGES if DOCS / "log" not in page.parents] + sorted((ROOT / "notebooks").glob("*.ipynb"))
SECTION = r"(?:download|train_model|generate_rollouts|policy|train_policy|evaluate)"
ASSIGNED = re.compile(rf"({SECTION}(?:\.\w+)*|seed|threads|precision|compile)(?:: |=)(\S.*)")
FLAG = re.compile(rf"(--)?({SECTION}(?:\.\w+)+)(?:=(\S.*))?")


def prose(path: Path) -> str:
    """A page's text; a notebook's markdown."""
    if path.suffix == ".md":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def suggestions(text: str) -> Iterator[list[str]]:
    """Overrides `section.key=value`; those of one sentence's paragraph or list item, block or line belong together."""
    fence = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
    for language, block in fence.findall(text):
        if language == "yaml":
            tree = YAML(typ="safe", pure=True).load(block)
            yield [f"{key}={json.dumps(value)}" for key, value in tree.items()]
        else:
            yield from map(flags, re.sub(r"\\\n", "", block).splitlines())
    for item in re.split(r"\n\s*\n|\n(?=\s*(?:[-*|]|\d+\.) )", fence.sub("", text)):
        spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", item)]
        found = [f"{match[1]}={match[2]}" for span in spans if (match := ASSIGNED.fullmatch(span))]
        yield found + [flag for span in spans if not ASSIGNED.fullmatch(span) for flag in flags(span)]


def flags(line: str) -> list[str]:
    """What a command has behind `-S` or `--`."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:  # prose, or another language
        return []
    matches = [(match, after) for word, after in pairwise([*words, ""]) if (match := FLAG.fullmatch(word))]
    return [f"{match[2]}={match[3] or after}" for match, after in matches if match[3] or (match[1] and after)]


CASES = [(path, found) for path in SOURCES for found in suggestions(prose(path)) if found]


def leaves(values: Any, key: str) -> Iterator[tuple[str, Any]]:
    if not isinstance(values, dict):
        yield key, values
        return
    for name, item in values.items():
        yield from leaves(item, f"{key}.{name}")


@cache
def standing() -> dict[str, Any]:
    """What the repository's params.yaml says, by keys."""
    tree = dump_params(load_params(ROOT / "params.yaml"))
    return {key: value for name, item in tree.items() for key, value in leaves(item, name)}


@pytest.mark.parametrize(
    ("path", "overrides"), CASES, ids=[f"{path.name}: {', '.join(found)}" for path, found in CASES]
)
def test_what_is_suggested_is_accepted_and_changes_something(path: Path, overrides: list[str]) -> None:
    load_params(ROOT / "params.yaml", overrides)
    for override in overrides:
        key, _, text = override.partition("=")
        assert [k for k, v in leaves(YAML(typ="safe", pure=True).load(text), key) if standing().get(k, ...) == v] == []


def test_suggestions_are_found_in_every_form() -> None:
    text = (
        "Try `train_policy.cql.cql_weight: 1`,\nor `policy.updates=9000`.\n\n1. `train_model.transformer.width: 8`\n"
        "2. `envtf evaluate --evaluate.episodes 3`\n\n```bash\ndvc exp run -S seed=1 -S policy.n_step=2  # x\n```\n"
        "`download: {source: file}`, `models/policy/x`, `policy.updates` and `--data.path=x`\n"
        "```yaml\ntrain_policy:\n  x: {algorithm: cql}\n```\n"
    )
    assert [*filter(None, suggestions(text))] == [
        ["policy.n_step=2"],
        ['train_policy={"x": {"algorithm": "cql"}}'],
        ["train_policy.cql.cql_weight=1", "policy.updates=9000"],
        ["train_model.transformer.width=8"],
        ["evaluate.episodes=3"],
        ["download={source: file}"],
    ]
    for name, least in (("README.md", 5), ("datasets.md", 4), ("report.ipynb", 3)):
        assert sum(len(found) for path, found in CASES if path.name == name) >= least, name
