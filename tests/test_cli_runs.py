"""`envtf` at work: what its commands write, and signals, full disks and missing back ends that come in between."""

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.pipeline.yaml import dump_params, load_params, params_yaml, preset_params
from tests import logs
from tests.full_disk import full_disk
from tests.lightning_runs import NO_LOGGER, QUIET
from tests.processes import begun
from tests.test_cli import LIGHTNING, exit_status
from tests.walker import walker_dataset


@pytest.fixture(scope="module")
def tiny_download(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in which `envtf download` has run."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "params.yaml").write_text(params_yaml(preset_params("tiny")))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert exit_status(["download", "--quiet", "--threads", "1", "--download.transitions=1000"]) == 0
    return folder


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_training_with_a_sentence(
    number: int, tiny_download: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lightning, which has handlers of its own, ends such a run with status 1 or 0."""
    monkeypatch.chdir(tiny_download)
    monkeypatch.setattr(
        "lightning.pytorch.callbacks.Callback.on_train_batch_end", lambda *_: signal.raise_signal(number)
    )
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert exit_status(["train_model", "--quiet"]) == 128 + number
    assert capsys.readouterr().err.splitlines()[-1].startswith("envtf: Interrupted. The same command continues")
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


WAITING = """
import concurrent.futures, multiprocessing, sys, time
from envtf_lit.cli import main, project

def doctor():
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        waiting = pool.submit(time.sleep, 600)
        while not waiting.running():
            time.sleep(0.01)
        print("ready", flush=True)
        waiting.result()

if __name__ == "__main__":
    project.FUNCTIONS["doctor"] = doctor
    doctor.__doc__ = "Waits."
    main.main(["doctor"])
"""


def test_a_pool_does_not_hold_up_a_termination(tmp_path: Path) -> None:
    (tmp_path / "waiting.py").write_text(WAITING)
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with begun([sys.executable, "waiting.py"], cwd=tmp_path, **pipes) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        process.terminate()
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 143
    assert "envtf: Interrupted. The same command begins anew." in errors.splitlines()


PATIENCE = 300.0  # seconds, within which even a machine that is busy with other things ends a process
LISTED = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are listed there")


def children(process: int) -> set[int]:
    """Numbers of the processes that it started, and that these started, by the kernel's own list."""
    direct = {
        int(word) for task in Path(f"/proc/{process}/task").glob("*/children") for word in task.read_text().split()
    }
    return direct.union(*map(children, direct))


def is_alive(process: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def wait_until_none_lives(processes: set[int]) -> None:
    deadline = time.monotonic() + PATIENCE
    while any(map(is_alive, processes)):
        assert time.monotonic() < deadline, "a worker is left"
        time.sleep(0.02)


POOL = """
import concurrent.futures, multiprocessing, time
from envtf_lit.workers import end_with_parent

if __name__ == "__main__":
    with concurrent.futures.ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        waiting = [pool.submit(time.sleep, 600) for _ in range(2)]
        while not all(future.running() for future in waiting):
            time.sleep(0.01)
        print("ready", flush=True)
        waiting[0].result()
"""


@LISTED
def test_workers_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "pool.py").write_text(POOL)
    quiet = dict(stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    with begun([sys.executable, "pool.py"], cwd=tmp_path, **quiet) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        workers = children(process.pid)
        assert len(workers) >= 2 and all(map(is_alive, workers))
        process.kill()
    wait_until_none_lives(workers)


def is_collecting(process: int) -> bool:
    """Whether a worker has begun: then it has MuJoCo in its memory; the tracker never does."""
    maps = Path(f"/proc/{process}/maps").read_text() if is_alive(process) else ""
    command = Path(f"/proc/{process}/cmdline").read_text() if is_alive(process) else ""
    return "resource_tracker" in command or "libmujoco" in maps


@LISTED
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_no_worker_outlives_a_download(number: int, project: Path) -> None:
    """Killed, it can tell them nothing; the kernel's own killer does not ask either."""
    command = [sys.executable, "-m", "envtf_lit", "download", "--quiet", "--threads=2", "--download.transitions=400000"]
    with begun(command, cwd=project, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        # two, and Python's tracker
        while len(found := children(process.pid)) < 3 or not all(map(is_collecting, found)):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(number)
        process.wait(timeout=PATIENCE)
    wait_until_none_lives(found)


def test_an_output_that_is_not_utf8_shows_stand_ins(tiny_download: Path) -> None:
    shown = run(tiny_download, "data", "check", "data/dataset.h5", PYTHONIOENCODING="ascii")
    assert "1,000 transitions" in shown and "?" in shown


def test_params_prints_what_init_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["params", "--preset", "tiny"]) == 0
    printed = capsys.readouterr().out
    assert exit_status(["init", str(tmp_path / "new"), "--preset", "tiny"]) == 0
    assert (tmp_path / "new" / "params.yaml").read_text() == printed
    assert dump_params(load_params(tmp_path / "new" / "params.yaml")) == dump_params(preset_params("tiny"))


def test_init_leaves_an_existing_project_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dvc.yaml").write_text("mine")
    assert exit_status(["init", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dvc.yaml"]
    assert (tmp_path / "dvc.yaml").read_text() == "mine"


def test_init_with_a_log_checks_it_and_trains_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    logs.write(tmp_path / "mine.npz", logs.columns(4, 2))
    assert exit_status(["init", "projects/new", "--preset", "tiny", "--data", "mine.npz"]) == 0
    assert "12 transitions" in capsys.readouterr().out
    params = load_params("projects/new/params.yaml")
    assert (params.task, params.download.source, params.download.path) == (None, "file", "../../mine.npz")
    assert params.train_model == preset_params("tiny").train_model
    monkeypatch.chdir("projects/new")
    assert exit_status(["download", "--quiet"]) == 0
    assert load_dataset("data/dataset.h5").observation_dim == 4


def test_init_with_a_log_that_names_its_task_says_how_to_score_in_mujoco(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = logs.write(tmp_path / "mine.h5", logs.columns() | {"task": "hopper-medium"})
    assert exit_status(["init", str(tmp_path / "new"), "--data", str(file)]) == 0
    assert "`task: hopper-medium`" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", ["bad.npz", "log.csv", "missing.h5"])
def test_init_writes_nothing_for_a_log_that_cannot_be_trained_on(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs.write(tmp_path / "bad.npz", logs.columns() | {"rewards": np.full(12, np.nan)})
    (tmp_path / "log.csv").write_text("a,b")
    assert exit_status(["init", str(tmp_path / "new"), "--data", str(tmp_path / name)]) == 2
    said = capsys.readouterr()
    assert {"bad.npz": "mend the file first", "log.csv": "envtf data convert", "missing.h5": "is not a file"}[name] in (
        " ".join((said.out + said.err).split())
    )
    assert not (tmp_path / "new").exists()


def test_doctor_reports_what_a_bug_report_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["doctor"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert {"python", "torch", "mujoco", "cores", "device", "memory", "disk", "rendering"} <= lines.keys()
    assert "missing" not in lines.values()


def test_a_stage_writes_its_outputs_and_prints_its_metrics(tiny_download: Path) -> None:
    dataset = load_dataset(tiny_download / "data" / "dataset.h5")
    assert len(dataset) == 1000
    assert json.loads((tiny_download / "data" / "dataset.json").read_text())["transitions"] == 1000


def test_flags_that_dvc_would_undo_are_said_to_be_so(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (project / "my.h5").write_bytes(b"rows")
    flags = ["--download.source", "file", "--download.path=my.h5"]
    assert exit_status(["source", *flags]) == 0
    assert capsys.readouterr().err == ""
    (project / "dvc.yaml").touch()
    assert exit_status(["source", *flags]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("params.yaml does not say download.source=file download.path=my.h5: the next `dvc repro`")
    assert exit_status(["source"]) == 0
    assert capsys.readouterr().err == ""


def test_a_stage_refuses_another_robots_dataset(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It would train to the end under the wrong rule of falling."""
    save_dataset(replace(walker_dataset(), task="hopper-medium"), project / "data/dataset.h5")
    for words in (["train_policy", "bc"], ["generate_rollouts", "transformer"], ["evaluate"]):
        assert exit_status([*words, "--quiet", "--task=ant-medium"]) == 2
        assert "was made for hopper-medium, and task is ant-medium" in " ".join(capsys.readouterr().err.split())


def test_a_file_in_the_home_folder_is_found(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In params.yaml no shell expands its name."""
    monkeypatch.setenv("HOME", str(project))
    (project / "my.h5").write_bytes(b"rows")
    text = (
        (project / "params.yaml")
        .read_text()
        .replace("source: zoo", "source: file")
        .replace("path: null", "path: ~/my.h5")
    )
    (project / "params.yaml").write_text(text)
    assert exit_status(["source"]) == 0
    noted = json.loads((project / "data/source.json").read_text())
    assert noted == {"path": str(project / "my.h5"), "sha256": hashlib.sha256(b"rows").hexdigest()}


@pytest.mark.parametrize("kind", LIGHTNING)
def test_lightnings_help_says_that_a_config_is_trusted(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status([kind, "--help"]) == 0
    assert "trusted like code" in " ".join(capsys.readouterr().out.split())


# Lightning 2.6's use of an older jsonargparse's names
@pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")
def test_lightnings_command_lines_refuse_bad_input_alike(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(["model", "fit", "--data.path", "nowhere.h5"]) == 2
    said = capsys.readouterr()
    assert "envtf: nowhere.h5" in said.err.splitlines()[-1]
    assert "Traceback" not in said.out + said.err


@pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")
def test_a_disk_that_is_full_of_checkpoints_is_said_in_a_sentence(
    tiny_download: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sizes = {"layers": 1, "width": 16, "context": 4, "updates_per_epoch": 2, "updates": 2}
    options = [f"--model.options.{key}={value}" for key, value in sizes.items()]
    fit = ["model", "fit", "--data.path", str(tiny_download / "data/dataset.h5"), NO_LOGGER, *QUIET, *options]
    import_module("envtf_lit.cli.lightning")  # Python's own files of bytecode are larger, too
    with full_disk(4_000):
        assert exit_status(fit) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("envtf: No space left ")  # which file met it first is the machine's
    assert not list(tmp_path.rglob("*.ckpt")) and not list(tmp_path.rglob("published"))


@pytest.mark.slow
def test_a_rendering_back_end_that_is_not_there_stops_neither_stage_nor_doctor(project: Path) -> None:
    run(project, "download", "--quiet", "--download.transitions=1000", MUJOCO_GL="osmesa")
    assert (project / "data/dataset.h5").exists()
    report = run(project, "doctor", MUJOCO_GL="glut")  # none of MuJoCo's: nowhere installed
    assert "MUJOCO_GL        glut" in report and "rendering " in report


def run(folder: Path, *arguments: str, **variables: str) -> str:
    """Runs `envtf` in a process of its own and returns all that it printed."""
    result = subprocess.run(
        [sys.executable, "-m", "envtf_lit", *arguments],
        cwd=folder,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout
    return result.stdout
