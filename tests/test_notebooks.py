"""The tutorials: each is cut as a tutorial should be, runs at its tiny size, and its exercises can be solved."""

import re
from pathlib import Path

import nbformat
import papermill
import pytest
from made_up_comparison import some_run, write_comparison
from ruamel.yaml import YAML
from tutorials import NAMES, NOTEBOOKS, cells, outputs, solutions, with_solutions

from envtf_lit.cli.main import main
from envtf_lit.comparison.records import Run
from envtf_lit.errors import UserError
from envtf_lit.figures.notebook import execute
from envtf_lit.project.tutorials import TINY, run_tutorial, tiny_parameters

TYPES = ("bool", "float", "int", "str")
named = pytest.mark.parametrize("name", NAMES)


# how they are cut


def test_each_is_a_stage_and_has_a_tiny_size() -> None:
    yaml = YAML(typ="safe", pure=True)
    stages = yaml.load(NOTEBOOKS / "dvc.yaml")["stages"]
    assert [*stages["tutorial"]["foreach"], "08_results"] == NAMES
    assert stages["results"]["always_changed"]  # what it reads is no dependency, which DVC would have to make first
    assert [*yaml.load(NOTEBOOKS / TINY)] == NAMES


@named
def test_parameters_are_typed_and_commented(name: str) -> None:
    parameters = papermill.inspect_notebook(NOTEBOOKS / f"{name}.ipynb")
    assert [key for key, found in parameters.items() if found["inferred_type_name"] not in TYPES] == []
    assert [key for key, found in parameters.items() if len(found["help"]) < 10] == []
    assert "seed" in parameters
    assert tiny_parameters(name, NOTEBOOKS).keys() <= parameters.keys()


@named
def test_its_head_says_what_it_needs_and_what_you_will_know(name: str) -> None:
    head, parameters, *_ = cells(name)
    assert re.match(rf"# {int(name[:2])} · ", head.source)
    for words in (r"\d+ minutes?\b", r"\bmemory\b.*\d G?M?B", r"\*\*You will know\*\*"):
        assert re.search(words, head.source), words
    assert parameters.metadata["tags"] == ["parameters"]


@named
def test_text_and_code_alternate_in_short_cells(name: str) -> None:
    assert 25 <= len(cells(name)) <= 60
    kinds = [cell.cell_type for cell in cells(name)]
    code = [place for place, kind in enumerate(kinds) if kind == "code"]
    assert [place for place in code[1:] if kinds[place - 1] == "code"] == []
    assert max(len(cell.source.splitlines()) for cell in cells(name, "code")) <= 15
    told = [re.sub(r"<details>.*</details>", "", cell.source, flags=re.DOTALL) for cell in cells(name, "markdown")]
    assert max(len(text.split()) for text in told) <= 160
    assert 1_000 <= sum(len(text.split()) for text in told) <= 2_200


@named
def test_no_algorithm_lives_in_it(name: str) -> None:
    assert [
        cell.source for cell in cells(name, "code") if re.search(r"^\s*(def|class|while) ", cell.source, re.M)
    ] == []


@named
def test_it_checks_itself_and_has_exercises_with_solutions(name: str) -> None:
    text = "\n".join(cell.source for cell in cells(name, "code"))
    assert 2 <= len(re.findall(r"^\s*assert ", text, re.MULTILINE)) <= 4
    (exercises,) = (cell.source for cell in cells(name, "markdown") if cell.source.startswith("## Try it yourself"))
    asked = re.findall(r"^\d\. ", exercises, re.MULTILINE)
    assert 3 <= len(asked) <= 5
    assert [*solutions(name)] == [f"Solution {number + 1}" for number in range(len(asked))]
    assert "" not in solutions(name).values()
    assert "**Where it breaks.**" in cells(name, "markdown")[-1].source


# that they run


@named
def test_it_runs_at_its_tiny_size_with_its_solutions(name: str, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    parameters = tiny_parameters(name, NOTEBOOKS) | {"folder": str(tmp_path / "work")}
    page = execute(with_solutions(name, tmp_path), tmp_path / "out" / f"{name}.ipynb", parameters, folded=False)
    found = outputs(page.with_suffix(".ipynb"))
    assert [output for output in found if output.get("name") == "stderr"] == []
    said = " ".join(output["data"].get("text/markdown", "") for output in found if "data" in output)
    told = re.sub(r"```.*?```", "", said, flags=re.DOTALL)  # sources that are shown may speak of infinity
    assert len(told) > 500 and not re.search(r"\bnan\b|\binf\b|None", told)
    assert str(tmp_path) not in str(found)
    assert "<summary>code</summary>" not in page.read_text("utf-8")


def test_a_tutorial_is_run_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = nbformat.v4.new_code_cell("size: int = 9  # of it", metadata={"tags": ["parameters"]})
    show = nbformat.v4.new_code_cell("from pathlib import Path; print(size, Path.cwd().name)")
    folder, notebook = tmp_path / "some", nbformat.v4.new_notebook(cells=[cell, show])
    folder.mkdir()
    nbformat.write(notebook, folder / "01_small.ipynb")
    (folder / TINY).write_text("01_small: {size: 2}\n")
    for tiny, said in (([], "9 some"), (["--tiny"], "2 some")):
        main(["tutorial", "01_small", "--notebooks", str(folder), "--out", str(tmp_path / "out"), "--quiet", *tiny])
        assert "01_small.html" in capsys.readouterr().out
        assert outputs(tmp_path / "out/01_small.ipynb")[0]["text"].strip() == said
    with pytest.raises(UserError, match="no tutorial '01_smal': did you mean '01_small'"):
        run_tutorial("01_smal", folder, out=tmp_path)
    (folder / TINY).write_text("{}\n")
    with pytest.raises(UserError, match="has no section 01_small"):
        run_tutorial("01_small", folder, out=tmp_path, tiny=True)
    with pytest.raises(UserError, match="has no tutorials"):
        run_tutorial("01_small", tmp_path, out=tmp_path)


# the one that reads results, whatever part of a grid they are


def read_results(tmp_path: Path, runs: list[Run], kit: str) -> str:
    """What is said by the tutorial on results, at its tiny size, of some runs."""
    write_comparison(tmp_path / "results.csv", runs, {"ant-medium": (20.0, 60.0)})
    name, given = "08_results", {"results": str(tmp_path / "results.csv"), "kit": kit, "folder": str(tmp_path / "work")}
    parameters = tiny_parameters(name, NOTEBOOKS) | given | {"seeds": 1}
    execute(with_solutions(name, tmp_path), tmp_path / "out.ipynb", parameters, folded=False)
    found = outputs(tmp_path / "out.ipynb")
    assert [output for output in found if output.get("name") == "stderr"] == []
    said = "\n".join(output["data"].get("text/markdown", "") for output in found if "data" in output)
    assert not re.search(r"\bnan\b|\binf\b|None", said)
    return said


def test_results_of_several_seeds_have_intervals_and_verdicts(tmp_path: Path) -> None:
    levels = {"wbc": 30.0, "cql": 50.0, "et_cql": 70.0}
    runs = [
        some_run(task, name, level + 3 * seed, seed=seed)
        for name, level in levels.items()
        for task in ("hopper-medium", "ant-medium", "ant-random")
        for seed in range(3)
    ]
    said = read_results(tmp_path, runs, "same")
    assert "**27 runs** of Weighted BC, CQL, ET + CQL, on 3 of 20 tasks" in said
    assert "393 of 420 planned runs are missing. Nothing at all is there of ReBRAC, IQL, COMBO, MOBILE." in said
    assert "9 of 9 cells have an interval." in said and "ET + CQL is above CQL on 3 of 3 tasks." in said
    assert "| +20.0 ± 0.0 over 3 tasks | **reproduces** |" in said and "1 of 5 reproduce, 0 do not, 4 are open" in said
    assert "Those made above stand in" not in said


def test_a_single_run_has_no_interval_and_leaves_all_open(tmp_path: Path) -> None:
    said = read_results(tmp_path, [some_run("ant-medium", "et_cql_paper", 40.0, kit="published")], "published")
    assert "on 1 of 20 tasks" in said and "No cell has an interval: each has one seed" in said
    assert "There are no two algorithms with runs on a common task." in said
    assert "0 of 5 reproduce, 0 do not, 5 are open" in said
    assert "0 of 1 tasks" in said and "`envtf compare run --kits published --seeds 0 1 2`" in said


def test_without_results_it_says_which_command_makes_them(tmp_path: Path) -> None:
    said = read_results(tmp_path, [some_run("ant-medium", "cql", 40.0)], "published")
    assert "No runs of the kit `published` yet: `envtf compare run --kits published` makes them." in said
    assert "**2 runs** of CQL, Weighted BC, on 1 of 20 tasks: 30 updates" in said
