"""Commands that write a result refuse, before any work, to put it in the place of anything else."""

import json
from pathlib import Path

import pytest

from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.results import claim
from envtf_lit.studies.suite import SuiteOptions, build_suite

MARKS = {
    "hidden": "measured.unseen",
    "horizon": "measured.trajectories",
    "calibrate": "calibration.points",
    "bench model": "train_fraction_of_matmul_peak",
    "bench agents": "default_updates_per_second",
    "bench cost": "target_error",
}
BESIDE = {
    "hidden": ["r.png", "r.csv"],
    "horizon": ["r.md", "r/open_loop.png", "r/ceiling.csv"],
    "calibrate": ["r.md", "r.png", "r.csv"],
}
OTHERS = ["", "{", "[1]", json.dumps({"mine": 1}), "\x00"]


def refused(command: str, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--out", str(out)])
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("command", MARKS)
def test_what_is_no_result_of_the_command_stays(
    command: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, before = project / "r.json", {path: path.read_bytes() for path in project.iterdir()}
    for text in (*OTHERS, *(json.dumps({mark: 1}) for name, mark in MARKS.items() if name != command)):
        out.write_text(text)
        assert f"{out} would be replaced, and is no earlier result" in refused(command, out, capsys)
        assert {path: path.read_bytes() for path in project.iterdir()} == before | {out: text.encode()}
    (project / "folder.json").mkdir()
    assert "folder.json would be replaced" in refused(command, project / "folder.json", capsys)


@pytest.mark.parametrize(("command", "name"), [(command, name) for command, names in BESIDE.items() for name in names])
def test_tables_and_figures_beside_it_replace_nothing_either(
    command: str, name: str, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (project / name).parent.mkdir(exist_ok=True)
    (project / name).write_text("mine")
    assert f"{project / name} would be replaced" in refused(command, project / "r.json", capsys)
    place = project / name if Path(name).parent == Path(".") else project / "r"
    assert "choose a name ending in .json" in refused(command, place, capsys)
    assert (project / name).read_text() == "mine" and not (project / "r.json").exists()


def test_an_earlier_result_is_replaced_with_all_beside_it(tmp_path: Path) -> None:
    claim(tmp_path / "r.json", "mark", [tmp_path / "r.md"])
    (tmp_path / "r.json").write_text('{"mark": 1, "more": 2}')
    (tmp_path / "r.md").write_text("of the earlier one")
    claim(tmp_path / "r.json", "mark", [tmp_path / "r.md"])


@pytest.mark.parametrize("name", ["data.json", "data/dataset.h5", "models/ensemble", "models/ensemble.json"])
def test_a_suite_is_not_built_over_files_of_ones_own(name: str, tmp_path: Path) -> None:
    mine = tmp_path / "hopper-random" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(UserError, match=rf"{name} would be replaced, and is none of what was kept here"):
        build_suite(
            "hopper-random", tmp_path, SuiteOptions(transitions=1_000, threads=1), models=["ensemble"], progress=False
        )
    assert mine.read_text() == "mine"
