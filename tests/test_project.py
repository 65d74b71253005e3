"""The project around the package: notebooks, README, what `envtf init` writes and what a built wheel brings."""

import json
import os
import re
import shlex
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from envtf_lit.cli.main import main
from envtf_lit.pipeline.yaml import load_params
from tests.test_dvc import ROOT, SEVEN, STRONG, all_params, stages

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
    assert load_params(ROOT / "params.yaml", overrides) != all_params()


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= 700


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
    assert {name: found["episodes"] for name, found in metrics["policies"].items()} == {"bc": 2, "cql": 2, "et_cql": 2}
    again = call("dvc", "repro")
    assert re.findall(r"Running stage '(.*)'", again) == ["source"]  # which looks whether a file of one's own changed
    assert again.count("didn't change, skipping") == len(stages()) - 1
    assert (tmp_path / "dvc.yaml").read_text() == pipeline_before
    call("git", "add", ".")
    call("git", "-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", "run")
    again = call("dvc", "exp", "run", "-S", "train_policy.et_cql.cql_weight=1")
    ran = [stage for stage in re.findall(r"Running stage '(.*)'", again) if stage != "source"]
    assert ran == ["train_policy@et_cql", "evaluate", "report"]
    call("git", "checkout", "params.yaml", "dvc.lock")
    call("dvc", "checkout")
    assert json.loads((tmp_path / "reports/metrics.json").read_text()) == metrics


@pytest.mark.slow
def test_dvc_sees_a_section_that_was_added(tmp_path: Path) -> None:
    main(["init", str(tmp_path), "--preset", "tiny"])
    text = (tmp_path / "params.yaml").read_text()
    for stage, section in (("train_policy", STRONG), ("train_model", SEVEN)):
        text = re.sub(rf"^{stage}:.*$", rf"\g<0>\n  {section}", text, flags=re.MULTILINE)
    (tmp_path / "params.yaml").write_text(text)

    def dvc(*words: str) -> list[str]:
        command, env = [sys.executable, "-m", "dvc", *words], environment(Path(sys.prefix))
        return subprocess.run(
            command, cwd=tmp_path, env=env, capture_output=True, text=True, check=True
        ).stdout.splitlines()

    added = {"train_policy@cql_strong", "train_model@seven", "generate_rollouts@seven"}
    assert {*dvc("stage", "list", "--all", "--name-only")} == stages().keys() | added
    edges = {line for line in dvc("dag", "--dot", "train_policy@cql_strong") if "->" in line}
    # from no model, nor from its rollouts
    assert edges == {'"source" -> "download";', '"download" -> "train_policy@cql_strong";'}


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
