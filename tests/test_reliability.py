"""What docs/reliability.md promises, at length: kills, full disks, two of a stage at once, changed bytes.

All slow: `make test-all` runs them.
"""

import contextlib
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envtf_lit.cli.saved_options import checkpoint_options
from envtf_lit.data.check_report import inspect_source
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.imagination.store import load_rollouts
from envtf_lit.pipeline.evaluate import _curves
from envtf_lit.pipeline.yaml import load_params, params_yaml, preset_params
from envtf_lit.policy import load_policy
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.world_models.store import load_world_model
from tests.walker import walker_dataset

pytestmark = pytest.mark.slow

SHORT = ["--train_model.transformer.updates=60", "--train_model.transformer.updates_per_epoch=20"]
SHORT += ["--policy.updates=200", "--policy.updates_per_epoch=50", "--generate_rollouts.branches=200"]
SHORT += ["--train_policy.et_cql.value_gradient.updates=20", "--download.transitions=2000"]
STAGES = {  # what each writes, beside the logs of `.envtf`
    ("download",): "data/dataset.h5",
    ("train_model",): "models/world_model/transformer",
    ("train_policy", "bc"): "models/policy/bc",
    ("generate_rollouts",): "data/rollouts/transformer.h5",
    ("train_policy", "cql"): "models/policy/cql",
}
KILLS = {("download",): 15, ("train_model",): 20, ("train_policy", "bc"): 10, ("train_policy", "cql"): 15}  # 60
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": "1"}


def start(folder: Path, stage: tuple[str, ...], *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "envtf_lit", *stage, "--quiet", *SHORT, *more]
    quiet: dict[str, Any] = dict(stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    return subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, start_new_session=True, **quiet)


def run(folder: Path, stage: tuple[str, ...]) -> None:
    process = start(folder, stage)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors


def digest(path: Path) -> str | None:
    """Of a file, or of a folder's files and their names; None where there is none."""
    if not path.exists():
        return None
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    content = b"".join(str(p.relative_to(path)).encode() + hashlib.sha256(p.read_bytes()).digest() for p in files)
    return hashlib.sha256(content).hexdigest()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in which every stage has run undisturbed."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "params.yaml").write_text(params_yaml(preset_params("tiny")))
    for stage in STAGES:
        run(folder, stage)
    return folder


def before(whole: Path, stage: tuple[str, ...], folder: Path) -> Path:
    """A copy of the project as it was before a stage ran."""
    shutil.copytree(whole, folder)
    shutil.rmtree(folder / ".envtf", ignore_errors=True)
    output = folder / STAGES[stage]
    shutil.rmtree(output) if output.is_dir() else output.unlink()
    return folder


def kill(process: subprocess.Popen[str]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


@pytest.mark.parametrize(("stage", "k"), [(stage, k) for stage, number in KILLS.items() for k in range(number)])
def test_a_killed_stage_leaves_nothing_half_and_a_rerun_the_same_bytes(
    stage: tuple[str, ...], k: int, whole: Path, tmp_path: Path
) -> None:
    folder, expected = before(whole, stage, tmp_path / "project"), digest(whole / STAGES[stage])
    begin = time.monotonic()
    run(before(whole, stage, tmp_path / "timed"), stage)
    process = start(folder, stage)
    time.sleep((time.monotonic() - begin) * (0.3 + 0.7 * (k + 0.5) / KILLS[stage]))  # imports come first
    kill(process)
    assert digest(folder / STAGES[stage]) in (None, expected)
    run(folder, stage)
    assert digest(folder / STAGES[stage]) == expected
    left = [path for path in (folder / STAGES[stage]).parent.iterdir() if path.name.endswith((".partial", ".old"))]
    assert left == []


def test_a_pipeline_that_is_killed_twenty_times_ends_with_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text((whole / "params.yaml").read_text())
    moments, kills = random.Random(0), 0
    for stage, output in STAGES.items():
        while kills < 20:
            process = start(tmp_path, stage)
            try:
                process.communicate(timeout=moments.uniform(3.0, 9.0))
                break
            except subprocess.TimeoutExpired:
                kill(process)
                kills += 1
            assert digest(tmp_path / output) in (None, digest(whole / output))
        run(tmp_path, stage)
        assert digest(tmp_path / output) == digest(whole / output)
    assert kills > 5


@pytest.mark.parametrize("stage", STAGES)
def test_two_of_a_stage_at_once_leave_one_whole_output(stage: tuple[str, ...], whole: Path, tmp_path: Path) -> None:
    folder = before(whole, stage, tmp_path / "project")
    both = [start(folder, stage), start(folder, stage)]
    said = [process.communicate(timeout=300)[1] for process in both]
    assert 0 in [process.returncode for process in both] and not any("Traceback" in text for text in said), said
    assert digest(folder / STAGES[stage]) == digest(whole / STAGES[stage])


FULL = """
import resource, sys
from envtf_lit.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, 2_000))  # every larger file fails as on a full disk
main(sys.argv[1:])
"""


@pytest.mark.parametrize("stage", STAGES)
def test_a_full_disk_ends_a_stage_in_a_sentence(stage: tuple[str, ...], whole: Path, tmp_path: Path) -> None:
    folder = before(whole, stage, tmp_path / "project")
    command = [sys.executable, "-c", FULL, *stage, "--quiet", *SHORT]
    done = subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "No space left" in done.stderr and "Traceback" not in done.stderr, done.stderr
    assert digest(folder / STAGES[stage]) is None
    run(folder, stage)
    assert digest(folder / STAGES[stage]) == digest(whole / STAGES[stage])


READ: dict[str, tuple[str, Callable[[Path], Any]]] = {  # of a project: where it lies below a copy, and what reads it
    "params": ("params.yaml", load_params),
    "HDF5": ("data/dataset.h5", inspect_source),
    "NPZ": ("data/dataset.npz", inspect_source),
    "rollouts": ("data/rollouts/transformer.h5", load_rollouts),
    "world model": ("models/world_model/transformer/weights.safetensors", lambda path: load_world_model(path.parent)),
    "world model's config": ("models/world_model/transformer/config.json", lambda path: load_world_model(path.parent)),
    "policy": ("models/policy/bc/weights.safetensors", lambda path: load_policy(path.parent)),
    "policy's config": ("models/policy/bc/config.json", lambda path: load_policy(path.parent)),
    "curves": ("models/policy/bc/curves.csv", lambda path: _curves(path.parent)),
    "metrics": ("models/policy/bc/metrics.json", read_json),
    "checkpoint": ("last.ckpt", lambda path: checkpoint_options(path, TransformerOptions)),
}


@pytest.fixture(scope="module")
def readable(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project with one file of every kind that we read."""
    folder = tmp_path_factory.mktemp("readable") / "project"
    shutil.copytree(whole, folder)
    save_dataset(walker_dataset(), folder / "data/dataset.npz")
    process = start(before(whole, ("train_model",), folder.with_name("killed")), ("train_model",))
    while not (found := list(folder.with_name("killed").rglob("last.ckpt"))):
        assert process.poll() is None
        time.sleep(0.01)
    shutil.copy(found[0], folder / "last.ckpt")
    kill(process)
    return folder


@pytest.mark.parametrize("kind", READ)
def test_bytes_changed_at_random_end_in_a_sentence_if_at_all(kind: str, readable: Path) -> None:
    """A hundred times: bytes flipped, a stretch cut out or doubled, the end cut off."""
    name, read = READ[kind]
    path, draws = readable / name, np.random.default_rng(0)
    sound = path.read_bytes()
    read(path)
    for _ in range(100):
        content, at = (
            bytearray(sound),
            int(draws.integers(min(len(sound), 4096) if draws.random() < 0.5 else len(sound))),
        )
        match draws.integers(4):
            case 0:
                for place in draws.integers(len(content), size=int(draws.integers(1, 20))):
                    content[place] = int(draws.integers(256))
            case 1:
                del content[at : at + int(draws.integers(1, 200))]
            case 2:
                content[at:at] = content[at : at + int(draws.integers(1, 200))]
            case _:
                del content[at:]
        path.write_bytes(content)
        begin = time.process_time()
        with contextlib.suppress(UserError):
            read(path)
        assert time.process_time() - begin < 5.0
    path.write_bytes(sound)
