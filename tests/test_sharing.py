"""Models that travel: to a folder, to a hub over HTTP, and back; cards; and all that a hub may do wrong."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from ruamel.yaml import YAML

from envtf_lit import sharing
from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.critics import Critics, load_critics, save_critics
from envtf_lit.errors import UserError
from envtf_lit.files import write_json
from envtf_lit.model_card import DATA_MEANS, MODEL_MEANS, POLICY_MEANS, model_card
from envtf_lit.policy import load_policy, save_policy
from envtf_lit.sharing import ALLOWED, pull, push
from envtf_lit.world_models.store import load_world_model, save_world_model
from envtf_lit.world_models.termination_head import TerminationHead, save_termination
from tests.hub import Hub, running
from tests.test_dvc import ROOT
from tests.worlds import small_transformer


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    folder = tmp_path / "models/mine"
    save_policy(folder, TanhGaussianActor(3, 2, hidden=(8,)))
    write_json(folder / "metrics.json", {"epoch": 9, "clone_loss": -3.25})
    write_json(folder / "resolved.json", {"algorithm": "cql", "seed": 0})
    (folder / "curves.csv").write_text("epoch\n1\n")
    return folder


@pytest.fixture
def judged(policy: Path) -> Path:
    """The policy, with critics."""
    save_critics(policy, Critics(3, 2, n=2, hidden=(8,), layer_norm=True, discount=0.9))
    return policy


@pytest.fixture
def world(tmp_path: Path) -> Path:
    folder = tmp_path / "models/world"
    save_world_model(folder, small_transformer())
    save_termination(folder / "termination", TerminationHead(3))
    return folder


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    with running(Hub()) as found:
        monkeypatch.setenv("HF_ENDPOINT", found.url)
        monkeypatch.setenv("HF_TOKEN", "hf_secret")
        yield found


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def card(folder: Path) -> str:
    return model_card(folder)


# a folder


def test_a_model_goes_to_a_folder_and_comes_back(policy: Path, tmp_path: Path) -> None:
    push(policy, str(tmp_path / "remote/mine"), card)
    assert contents(tmp_path / "remote/mine").keys() == {*contents(policy), "README.md"} - {"curves.csv"}
    pull(str(tmp_path / "remote/mine"), tmp_path / "again")
    came = contents(tmp_path / "again")
    assert came == {name: value for name, value in contents(policy).items() if name != "curves.csv"}
    observation = torch.randn(4, 3)
    assert torch.equal(load_policy(tmp_path / "again").act(observation), load_policy(policy).act(observation))


def test_a_world_model_brings_its_termination_head(world: Path, tmp_path: Path) -> None:
    push(world, str(tmp_path / "remote"), card)
    pull(str(tmp_path / "remote"), tmp_path / "again")
    assert contents(tmp_path / "again") == contents(world)


def test_a_policy_brings_its_critics(hub: Hub, judged: Path, tmp_path: Path) -> None:
    push(judged, str(tmp_path / "remote"), card)
    hub.files["a/b"] = contents(tmp_path / "remote")
    pull("hf:a/b", tmp_path / "again")
    came = contents(tmp_path / "again")
    assert came == {name: value for name, value in contents(judged).items() if name != "curves.csv"}
    observation = torch.randn(4, 3)
    assert torch.equal(load_critics(tmp_path / "again").value(observation), load_critics(judged).value(observation))
    assert "envtf_lit.load_critics" in card(judged)


def test_critics_are_checked_as_the_policy_is(judged: Path, tmp_path: Path) -> None:
    torch.save({}, judged / "critics/weights.safetensors")
    with pytest.raises(UserError, match=r"critics/weights\.safetensors is not a safetensors file"):
        pull(str(judged), tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_nothing_that_stands_there_is_replaced(policy: Path, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    with pytest.raises(UserError, match="here exists already: name a new folder"):
        push(policy, str(tmp_path / "here"), card)
    with pytest.raises(UserError, match="here exists already"):
        pull(str(policy), tmp_path / "here")
    assert not list((tmp_path / "here").iterdir())


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no weights": (lambda f: (f / "weights.safetensors").unlink(), "has no weights.safetensors"),
    "pickle": (lambda f: torch.save({}, f / "weights.safetensors"), "is not a safetensors file"),
    "foreign kind": (lambda f: write_json(f / "config.json", {"kind": "os.system"}), "unknown kind 'os.system'"),
    "broken metrics": (lambda f: (f / "metrics.json").write_text("{"), r"metrics\.json is not valid JSON"),
    "huge JSON": (lambda f: (f / "resolved.json").write_bytes(b" " * (5 << 20)), "has 5,242,880 bytes"),
    "no folder": (lambda f: f.rename(f.with_name("gone")), "is not a model folder: it does not exist"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_is_damaged_is_not_pulled(policy: Path, tmp_path: Path, damage: str) -> None:
    break_it, sentence = DAMAGE[damage]
    break_it(policy)
    with pytest.raises(UserError, match=sentence) as caught:
        pull(str(policy), tmp_path / "again")
    assert str(policy) in str(caught.value) and "partial" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"models"}


# the hub


def test_a_model_goes_to_the_hub_and_comes_back(
    hub: Hub, policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hub.token = "hf_secret"
    main(["push", str(policy), "hf:someone/a-model", "--licence", "mit"])
    assert hub.commits == ["someone/a-model"]
    assert hub.files["someone/a-model"].keys() == {*contents(policy), "README.md"} - {"curves.csv"}
    assert b'license: "mit"' in hub.files["someone/a-model"]["README.md"]
    main(["pull", "hf:someone/a-model", str(tmp_path / "again")])
    assert contents(tmp_path / "again").keys() == {
        "config.json",
        "weights.safetensors",
        "metrics.json",
        "resolved.json",
    }
    assert "Pulled TanhGaussianActor from hf:someone/a-model" in capsys.readouterr().out
    assert load_policy(tmp_path / "again")


def test_of_the_hubs_files_only_those_of_a_model_come(hub: Hub, world: Path, tmp_path: Path) -> None:
    evil = {"../../evil.py": b"x", "model.pkl": b"x", "termination/hook.py": b"x", "__init__.py": b"x"}
    hub.files["a/b"] = contents(world) | evil
    pull("hf:a/b", tmp_path / "again")
    assert contents(tmp_path / "again").keys() == contents(world).keys() <= ALLOWED.keys()
    assert load_world_model(tmp_path / "again")
    assert {path.name for path in tmp_path.iterdir()} == {"models", "again"}


def stated(hub: Hub) -> None:
    hub.stated["weights.safetensors"] = 17


def swapped(hub: Hub) -> None:
    hub.files["a/b"]["config.json"] = b'{"kind": "tanh_gaussian", "arguments": {}}'


def large(hub: Hub) -> None:
    hub.files["a/b"]["resolved.json"] = b" " * (5 << 20)


FAILURES: dict[str, tuple[Callable[[Hub], object], str]] = {
    "401": (
        lambda hub: setattr(hub, "token", "another"),
        r"asks for a token that may do this \(401\): `hf auth login`",
    ),
    "404": (lambda hub: hub.files.pop("a/b"), r"does not exist \(404\): check the name"),
    "500": (lambda hub: setattr(hub, "status", 500), "the hub answers 500: try again later"),
    "half a file": (lambda hub: setattr(hub, "half", "weights.safetensors"), "broke off .*: try again"),
    "half an answer": (lambda hub: setattr(hub, "half", "facts"), "broke off .*: try again"),
    "another size": (stated, r"weights.safetensors of hf:a/b came damaged \(.* bytes of 17\)"),
    "another model": (swapped, "hf:a/b/config.json does not describe a tanh_gaussian"),
    "too large": (large, "resolved.json of hf:a/b has .* bytes, and such a file has at most 4,194,304"),
    "no model": (lambda hub: hub.files.update({"a/b": {"README.md": b""}}), "hf:a/b has no config.json"),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_a_hub_that_fails_is_one_sentence_and_leaves_nothing(
    hub: Hub, policy: Path, tmp_path: Path, failure: str
) -> None:
    hub.files["a/b"] = contents(policy)
    fail, sentence = FAILURES[failure]
    fail(hub)
    with pytest.raises(UserError, match=sentence):
        pull("hf:a/b", tmp_path / "again")
    assert {path.name for path in tmp_path.iterdir()} == {"models"}


def test_a_hub_that_is_not_there(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(UserError, match="cannot be reached"):
        pull("hf:a/b", tmp_path / "again")
    with pytest.raises(UserError, match=r"hf:a/b at http://127\.0\.0\.1:9 cannot be reached"):
        push(policy, "hf:a/b", card)


@pytest.mark.parametrize(("status", "sentence"), [(401, r"\(401\): `hf auth login`"), (404, r"\(404\)"), (500, "500")])
def test_a_push_that_is_refused_is_one_sentence(hub: Hub, policy: Path, status: int, sentence: str) -> None:
    hub.status = status
    with pytest.raises(UserError, match=sentence) as caught:
        push(policy, "hf:a/b", card)
    assert "\n" not in str(caught.value) and "hf_secret" not in str(caught.value)
    assert not hub.commits


@pytest.mark.parametrize("name", ["hf:", "hf:one", "hf:a/b/c", "hf:a/..", "hf:../b", "hf:a/b?x", "hf:a b/c"])
def test_a_name_that_is_none_reaches_no_hub(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match="names no model on the hub: write hf:user/name"):
        pull(name, tmp_path / "again")


def test_only_models_are_pushed(tmp_path: Path, hub: Hub) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"config\.json does not exist"):
        push(tmp_path / "empty", "hf:a/b", card)
    assert not hub.files and sharing.HUB == "hf:"


# cards


def front(text: str) -> dict[str, object]:
    return YAML(typ="safe", pure=True).load(text.split("---\n")[1])


def test_a_card_says_what_is_known(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = {"task": "hopper-medium-replay", "dataset": {"transitions": 100000, "score_mean": 10.4}}
    scores |= {
        "policies": {"mine": {"label": "Mine", "score_mean": 93.917, "episodes": 20}, "other": {"score_mean": 1}}
    }
    (tmp_path / "reports").mkdir()
    write_json(tmp_path / "reports/metrics.json", scores)
    monkeypatch.chdir(tmp_path)
    main(["card", "models/mine", "--licence", "mit"])
    text = (policy / "README.md").read_text()
    assert front(text)["license"] == "mit" and front(text)["library_name"] == "envtf_lit"
    for line in ("# mine", "| task | hopper-medium-replay |", "| transitions | 100000 |", "| score_mean | 93.92 |"):
        assert f"\n{line}" in text, line
    assert "| score_mean | 93.92 | of its episodes in MuJoCo; 0 is a random policy" in text
    assert "actions from [-1.0, -1.0] to [1.0, 1.0]" in text and '"algorithm": "cql"' in text
    assert "load_critics" not in text
    assert "| clone_loss | -3.25 |" in text and "| envtf-lit |" in text and "Calibration" not in text
    with pytest.raises(SystemExit):
        main(["card", "models/mine"])
    assert (policy / "README.md").read_text() == text


def test_a_world_models_card_tells_its_calibration(world: Path, tmp_path: Path) -> None:
    write_json(tmp_path / "metrics.json", {"world_model": {"name": "world", "coverage_90": 0.896319}})
    text = model_card(world, report=tmp_path / "metrics.json")
    assert "## Calibration\n\n| | | |\n|---|---|---|\n| coverage_90 | 0.8963 | share of outcomes in its 90 %" in text
    assert "## Data\n\nNot recorded beside this model." in text
    assert front(text)["license"] == "unknown" and "ask whoever trained it" in text


def test_what_a_card_explains_stands_in_the_glossary() -> None:
    glossary = (ROOT / "docs/metrics.md").read_text()
    explained = POLICY_MEANS | MODEL_MEANS | DATA_MEANS
    # a mean's name stands there, and `…_std` or `…_max` beside it
    stems = {re.sub("_(std|max)$", "_mean", name) for name in explained}
    assert [name for name in stems if not re.search(rf"\b{re.escape(name)}\b", glossary)] == []
    means = [*DATA_MEANS.values(), *POLICY_MEANS.values(), *MODEL_MEANS.values()]
    assert [text for text in means if "|" in text or text != text.strip()] == []


def test_a_card_takes_no_markup_from_a_report(policy: Path, tmp_path: Path) -> None:
    report = {"task": "a | [b](http://c) <script>", "dataset": {"<b>": 1}}
    write_json(tmp_path / "metrics.json", report)
    write_json(policy / "resolved.json", {"x": "```\n# free"})
    text = model_card(policy, report=tmp_path / "metrics.json")
    assert "<" not in text and "](" not in text and text.count("```") == 4
    assert json.loads(text.split("```json\n")[1].split("\n```")[0]) == {"x": "\n# free"}
    with pytest.raises(UserError, match="names no licence"):
        model_card(policy, licence="mit\nx: y")
