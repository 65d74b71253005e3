"""The project around the package: pipeline, notebooks, README, and what a built wheel brings."""

import ast
import json
import os
import re
import shlex
import subprocess
import sys
import venv
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import grimp
import pytest
from ruamel.yaml import YAML

from envtf_lit.cli.main import STAGES, build_parser, main
from envtf_lit.pipeline.yaml import load_params

ROOT = Path(__file__).parent.parent
# every stage reads its options through these, and DVC tracks the options' values themselves
OPTIONS = {"envtf_lit.errors", "envtf_lit.options.schema", "envtf_lit.pipeline.params"}


def read_yaml(name: str) -> dict[str, Any]:
    return YAML(typ="safe", pure=True).load(ROOT / name)


def stages() -> dict[str, dict[str, Any]]:
    """dvc.yaml's stages by their full names, the foreach written out."""
    written = {}
    for name, stage in read_yaml("dvc.yaml")["stages"].items():
        if "foreach" not in stage:
            written[name] = stage
        for key, item in stage.get("foreach", {}).items():
            text = json.dumps(stage["do"]).replace("${key}", key)
            for slot, value in item.items():
                text = text.replace(f"${{item.{slot}}}", value)
            written[f"{name}@{key}"] = json.loads(text)
    return written


# the pipeline's own file


def test_every_stage_is_a_command_and_a_function() -> None:
    names = [name.partition("@")[0] for name in stages()]
    assert list(dict.fromkeys(names)) == list(STAGES)
    for name, stage in stages().items():
        namespace, rest = build_parser().parse_known_args(shlex.split(stage["cmd"])[1:])
        assert (namespace.command, rest) == (name.partition("@")[0], [])
        assert callable(getattr(import_module(f"envtf_lit.pipeline.{namespace.command}"), namespace.command))


def test_every_tracked_option_is_in_params_yaml() -> None:
    for stage in stages().values():
        for key in stage.get("params", []):
            tree = read_yaml("params.yaml")
            for name in key.split("."):
                assert name in tree, key
                tree = tree[name]


def test_every_option_is_tracked_by_some_stage() -> None:
    tracked = {key for stage in stages().values() for key in stage.get("params", [])}
    top = {key.partition(".")[0] for key in tracked}
    assert top == read_yaml("params.yaml").keys()
    assert {f"train_policy.{name}" for name in read_yaml("params.yaml")["train_policy"]} <= tracked


def test_the_policy_from_data_alone_is_not_trained_anew_for_imagination() -> None:
    cql, et_cql = stages()["train_policy@cql"], stages()["train_policy@et_cql"]
    assert "train_policy.et_cql" not in cql["params"]
    assert not {"data/rollouts.h5", "models/world_model"} & set(cql["deps"])
    assert {"data/rollouts.h5", "models/world_model"} <= set(et_cql["deps"])


def test_what_a_stage_reads_another_writes() -> None:
    outputs = {path for stage in stages().values() for path in stage["outs"]}
    for stage in stages().values():
        made = {path for path in stage.get("deps", []) if path.split("/")[0] in ("data", "models", "reports")}
        assert made <= outputs


def test_code_that_stages_name_exists() -> None:
    for stage in stages().values():
        assert [
            path for path in stage["deps"] if path.startswith(("envtf_lit", "notebooks")) and not (ROOT / path).exists()
        ] == []


# each stage's dependencies against its imports


@cache
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("envtf_lit")


def imported_names(node: ast.AST) -> set[str]:
    """The package's modules that the import statements below a syntax node name."""
    names = set()
    for statement in ast.walk(node):
        if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("envtf_lit"):
            inner = {f"{statement.module}.{alias.name}" for alias in statement.names}
            names |= inner & imports().modules or {str(statement.module)}
    return names


def is_options(module: str) -> bool:
    return module in OPTIONS or module.endswith(".options")


def modules_of(stage: str) -> set[str]:
    """All modules of the package that a stage's file imports, directly or through others, but for the options."""
    direct = {f"envtf_lit.pipeline.{stage.partition('@')[0]}"}
    for path in stages()[stage]["deps"]:
        if path.endswith(".ipynb"):
            cells = json.loads((ROOT / path).read_text())["cells"]
            code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
            direct |= imported_names(ast.parse("\n".join(code)))
    reached, waiting = set(), list(direct)
    while waiting:
        module = waiting.pop()
        reached.add(module)
        following = {name for name in imports().find_modules_directly_imported_by(module) if not is_options(name)}
        waiting += following - reached
    packages = {module for module in reached if imports().find_children(module)}
    return reached - packages


@pytest.mark.parametrize("stage", stages())
def test_a_stage_depends_on_the_code_it_imports_and_no_other(stage: str) -> None:
    declared = {path for path in stages()[stage]["deps"] if path.startswith("envtf_lit/")} - {"envtf_lit/assets/zoo"}
    needed = {f"{module.replace('.', '/')}.py" for module in modules_of(stage)}
    missing = {path for path in needed if not declared & {path, *map(str, Path(path).parents)}}
    idle = {path for path in declared if path not in needed and not any(p.startswith(f"{path}/") for p in needed)}
    assert (missing, idle) == (set(), set())


# notebooks


def notebooks() -> list[Path]:
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.name)
def test_notebooks_are_stored_clean_with_one_parameters_cell(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    assert sum("parameters" in cell["metadata"].get("tags", []) for cell in cells) == 1
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"]] == []


def test_there_is_a_report_notebook() -> None:
    assert "report.ipynb" in [path.name for path in notebooks()]


# git


def test_ignore_patterns_of_outputs_are_anchored() -> None:
    result = subprocess.run(
        ["git", "check-ignore", "envtf_lit/data/dataset.py", "envtf_lit/configs/presets/tiny.yaml", "data/README.md"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode in (1, 128), result.stdout  # 1: none is ignored, 128: a download without .git


# README


def commands_in_readme() -> list[str]:
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("command", [line for line in commands_in_readme() if line.startswith("envtf ")])
def test_readmes_envtf_commands_are_understood(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command)[1:]
    flags = [word.partition("=")[0] for word in words if word.startswith("--")]
    with pytest.raises(SystemExit) as stop:
        main([*[word for word in words[:2] if not word.startswith("-") and "/" not in word], "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert [flag for flag in flags if flag not in shown] == []


@pytest.mark.parametrize("command", [line for line in commands_in_readme() if line.startswith("make ")])
def test_readmes_make_commands_exist(command: str) -> None:
    result = subprocess.run([*shlex.split(command), "--dry-run"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("command", [line for line in commands_in_readme() if "-S " in line])
def test_readmes_experiments_change_real_options(command: str) -> None:
    overrides = re.findall(r"-S (\S+)", command)
    assert load_params(ROOT / "params.yaml", overrides) != load_params(ROOT / "params.yaml")


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= 600


# the whole of it


def environment(folder: Path) -> dict[str, str]:
    """This process's environment with a virtual environment's programs first, as the Makefile has it."""
    return os.environ | {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}", "VIRTUAL_ENV": str(folder)}


@pytest.mark.slow
def test_tiny_pipeline_runs_once_and_an_experiment_reruns_only_its_part(tmp_path: Path) -> None:
    env = environment(Path(sys.prefix))

    def call(*command: str) -> str:
        result = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    main(["init", str(tmp_path), "--preset", "tiny"])
    call("git", "init", "-q")
    call("dvc", "config", "core.no_scm", "false")
    pipeline_before = (tmp_path / "dvc.yaml").read_text()
    call("dvc", "repro")
    metrics = json.loads((tmp_path / "reports/metrics.json").read_text())
    assert metrics["policy"]["episodes"] == 2
    assert call("dvc", "repro").count("didn't change, skipping") == len(stages())
    assert (tmp_path / "dvc.yaml").read_text() == pipeline_before
    call("git", "add", ".")
    call("git", "-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", "run")
    again = call("dvc", "exp", "run", "-S", "train_policy.et_cql.cql_weight=1")
    assert re.findall(r"Running stage '(.*)'", again) == ["train_policy@et_cql", "evaluate", "report"]
    call("git", "checkout", "params.yaml", "dvc.lock")
    call("dvc", "checkout")
    assert json.loads((tmp_path / "reports/metrics.json").read_text()) == metrics


@pytest.mark.slow
def test_a_built_wheel_brings_the_project_template(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path / "dist"), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    # the wheel is installed alone; what it depends on is seen through the environment that runs this test
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env/bin/python"
    subprocess.run([python, "-m", "pip", "install", "-q", "--no-deps", wheel], check=True, capture_output=True)
    site = next((tmp_path / "env/lib").glob("python*/site-packages"))
    packages = [path for path in sys.path if path.endswith("site-packages")]
    (site / "borrowed.pth").write_text("\n".join(packages))
    env = environment(tmp_path / "env")
    env.pop("PYTHONPATH", None)  # else the checkout might stand in for the wheel

    def call(*command: str, cwd: Path = tmp_path) -> str:
        result = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stdout + result.stderr
        return result.stdout

    where = call("python", "-c", "import envtf_lit; print(envtf_lit.__file__)")
    assert where.startswith(str(tmp_path))
    assert (Path(where.strip()).parent / "py.typed").is_file()
    assert "train_policy" in call("envtf", "--help")
    call("envtf", "init", "new", "--preset", "tiny")
    assert (tmp_path / "new/notebooks/report.ipynb").is_file()
    call("envtf", "download", "--quiet", cwd=tmp_path / "new")
    assert (tmp_path / "new/data/dataset.h5").is_file()
    call("envtf", "zoo", "build", "ant-medium", "--transitions", "200", "--workers", "1", "--quiet")
    assert "Ant-v5" in (tmp_path / "data/zoo/ant-medium.md").read_text()


def test_a_gpu_run_that_fails_keeps_what_it_had_measured(tmp_path: Path) -> None:
    envtf = tmp_path / "envtf.sh"
    measured = "hopper-medium/.envtf/runs/calibration.json"
    envtf.write_text(
        'work=$(sed -n "s/.*--work \\([^ ]*\\).*/\\1/p" <<<"$*")\n'
        f'[[ -z $work ]] || (mkdir -p "$work/{Path(measured).parent}" && echo {{}} >"$work/{measured}")\n'
        "[[ $1 != calibrate ]]\n"
    )
    command = ["bash", "benchmarks/gpu.sh", str(tmp_path / "out")]
    env = os.environ | {"ENVTF": f"bash {envtf}", "TMPDIR": str(tmp_path)}
    result = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and "not measured: calibrate" in result.stderr
    assert (tmp_path / "out/work" / measured).read_text() == "{}\n"
    assert {path.name for path in tmp_path.iterdir()} == {"envtf.sh", "out"}  # the work folder is gone
