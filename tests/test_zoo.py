"""`envtf zoo`: a folder of datasets with cards, a table and a figure; whole or absent, continued where it stopped."""

import json
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from envtf_lit.cli.main import main
from envtf_lit.data.cards import counted_episodes
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.errors import UserError
from envtf_lit.figures.zoo import score_distributions
from envtf_lit.robots.tasks import TASKS
from envtf_lit.zoo import build as zoo_module
from envtf_lit.zoo.build import Entry, build, catalogue

NAMES = ["hopper-medium", "hopper-random", "ant-random-105d", "halfcheetah-random-v4", "hopper-random-hidden"]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("zoo")
    main(["zoo", "build", *NAMES, "--out", str(folder), "--transitions", "300", "--workers", "1", "--quiet"])
    return folder


def build_again(folder: Path, names: list[str], transitions: int = 300, seed: int = 0) -> list[Entry]:
    return build(
        names,
        folder,
        transitions=transitions,
        seed=seed,
        workers=1,
        draw=score_distributions,
        progress=False,
        report=lambda line: None,
    )


def test_every_dataset_has_a_card_and_a_page(out: Path) -> None:
    for name in NAMES:
        dataset, card = load_dataset(out / f"{name}.h5"), json.loads((out / f"{name}.json").read_text())
        page = (out / f"{name}.md").read_text()
        assert dataset.task == card["task"] == name
        assert card["transitions"] == len(dataset) == 300
        assert card["returns"]["mean"] == pytest.approx(
            dataset.episode_returns[counted_episodes(dataset, "zoo")].mean()
        )
        assert card["bytes"] == (out / f"{name}.h5").stat().st_size
        for fact in (f"# {name}\n", card["env_id"], card["versions"]["mujoco"], "are not D4RL's files"):
            assert fact in page
        for policy in card["policies"]:
            assert f"| {policy['policy']} | {policy['transitions']:,} |" in page
    assert "`include_cfrc_ext_in_observation" not in (out / "ant-random-105d.md").read_text()
    pages = {name: (out / f"{name}.md").read_text() for name in NAMES}
    assert [name for name, page in pages.items() if "| hidden dynamics | friction, mass and" in page] == [NAMES[-1]]
    assert "HalfCheetah-v4" in (out / "halfcheetah-random-v4.md").read_text()


def test_table_and_figure_show_all_of_them(out: Path) -> None:
    rows = json.loads((out / "index.json").read_text())
    assert [row["task"] for row in rows] == ["hopper-random", "hopper-medium", *NAMES[2:]]
    page = (out / "index.md").read_text()
    for row in rows:
        card = json.loads((out / f"{row['task']}.json").read_text())
        assert row["max_score"] == pytest.approx(card["scores"]["max"], abs=0.051)
        assert row["megabytes"] == pytest.approx(card["bytes"] / 1e6, abs=0.1)
        assert f"| [{row['task']}]({row['task']}.md) | {row['env_id']} | 300 |" in page
    with Image.open(out / "returns.png") as figure:
        assert figure.size[0] > 500
    drawn = pd.read_csv(out / "returns.csv").set_index("task")
    assert drawn["mean"].to_dict() == pytest.approx({row["task"]: row["mean_score"] for row in rows}, abs=0.051)


def test_what_is_there_is_left_alone_and_what_was_asked_otherwise_is_made_anew(out: Path) -> None:
    path = out / "hopper-medium.h5"
    before = {file.name: file.stat().st_mtime_ns for file in out.glob("*.h5")}
    build_again(out, NAMES)
    assert {file.name: file.stat().st_mtime_ns for file in out.glob("*.h5")} == before
    (row,) = (entry for entry in build_again(out, ["hopper-medium"], transitions=310) if entry.task == "hopper-medium")
    assert (row.transitions, len(load_dataset(path))) == (310, 310)
    content = path.read_bytes()
    build_again(out, ["hopper-medium"], transitions=310, seed=1)
    assert path.read_bytes() != content
    build_again(out, ["hopper-medium"])


def test_each_dataset_is_reported_with_its_place_in_the_queue(out: Path) -> None:
    said: list[str] = []
    names = ["hopper-medium", "hopper-medium-v4"]
    build(names, out, transitions=300, seed=0, workers=1, draw=score_distributions, progress=False, report=said.append)
    assert said[0] == "1 of 2, hopper-medium: is there"
    assert said[1].startswith("2 of 2, hopper-medium-v4: mean score ")
    for path in out.glob("hopper-medium-v4.*"):
        path.unlink()


def test_a_dataset_without_its_card_is_unfinished(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after an interrupt between the two: the next call makes it again."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(zoo_module, "card_page", interrupt)
        with pytest.raises(KeyboardInterrupt):
            build_again(out, ["hopper-random", "hopper-medium"], transitions=320)
    assert json.loads((out / "hopper-random.json").read_text()) == {"source": "zoo", "task": "hopper-random"}
    assert not list(out.glob(".*partial"))
    table = build_again(out, ["hopper-random"])
    assert [entry.transitions for entry in table if entry.task == "hopper-random"] == [300]


def test_all_means_the_twenty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {}
    monkeypatch.setattr(zoo_module, "build", lambda tasks, out, **options: asked.update(options, tasks=tasks, out=out))
    main(["zoo", "build", "--all", "--full", "--out", str(tmp_path)])
    assert asked["tasks"] == [*TASKS]
    assert (asked["transitions"], asked["seed"], asked["out"]) == (1_000_000, 0, tmp_path)
    main(["zoo", "build", "ant-medium-105d", "--all"])
    assert asked["tasks"] == [*TASKS, "ant-medium-105d"]
    main(["zoo", "build", "ant-medium"])
    assert (asked["tasks"], asked["transitions"], asked["out"]) == (["ant-medium"], 200_000, Path("data/zoo"))


def test_cards_of_other_datasets_in_the_folder_are_left_alone(tmp_path: Path) -> None:
    build_again(tmp_path, ["hopper-random"])
    for name, card in (("dataset", {"source": "file"}), ("copy", {"source": "zoo", "task": "hopper-random"})):
        (tmp_path / f"{name}.h5").write_bytes((tmp_path / "hopper-random.h5").read_bytes())
        (tmp_path / f"{name}.json").write_text(json.dumps(card))
    assert [entry.task for entry in build_again(tmp_path, ["hopper-random"])] == ["hopper-random"]


@pytest.mark.parametrize(
    "name", ["hopper-random.h5", "hopper-random.json", "hopper-random.md", "index.json", "index.md", "returns.csv"]
)
def test_files_that_are_none_of_the_zoos_are_named_and_stay(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("[1]")
    with pytest.raises(UserError, match=rf"{name} would be replaced, and is none of what `zoo build` has made here"):
        build_again(tmp_path, ["hopper-medium", "hopper-random"])
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "[1]"}


def test_a_folder_that_cannot_be_made_and_a_negative_seed_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot hold datasets"):
        build_again(tmp_path / "file" / "zoo", ["hopper-random"])
    with pytest.raises(SystemExit):
        main(["zoo", "build", "hopper-random", "--seed", "-1"])
    assert "-1 is below zero" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "No task is named"),
        (["hoper-medium"], "hopper-medium"),
        (["hopper-full-replay"], "3 transitions are too few"),
    ],
)
def test_impossible_wishes_are_refused_before_anything_is_made(names: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        build_again(tmp_path, ["hopper-random", *names] if names else names, transitions=3)
    assert not list(tmp_path.iterdir())


def test_list_names_the_twenty(capsys: pytest.CaptureFixture[str]) -> None:
    main(["zoo", "list"])
    shown = capsys.readouterr().out
    assert [name for name in TASKS if name not in shown] == []
    words = {name: policies for name, policies, _ in catalogue()}
    assert words["hopper-random"] == "uniform random actions"
    assert words["hopper-medium"] == "snapshot after 150,000 steps"
    assert words["hopper-medium-replay"] == "random warm-up, then 12 snapshots up to 150,000 steps"
    assert words["hopper-medium-expert"] == "snapshots after 150,000 and 550,000 steps, half each"
