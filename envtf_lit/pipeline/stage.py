"""What the stages share: where their files lie, seeds and threads, timings."""

import contextlib
import resource
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning as L
import torch

from envtf_lit.agents.options import NO_WORLD_MODEL, PolicyOptions
from envtf_lit.devices import resolved
from envtf_lit.files import read_json, write_json
from envtf_lit.imagination.options import GenerateRolloutsOptions
from envtf_lit.pipeline.params import Params
from envtf_lit.robots.tasks import Robot, get_task
from envtf_lit.world_models.options import WorldModelOptions

SOURCE = Path("data/source.json")
DATASET, CARD = Path("data/dataset.h5"), Path("data/dataset.json")
WORLD_MODELS, POLICIES = Path("models/world_model"), Path("models/policy")  # a folder below for each name
ROLLOUTS = Path("data/rollouts")  # a file below for each world model
REPORTS, METRICS = Path("reports"), Path("reports/metrics.json")
PLOTS, VIDEO = Path("reports/plots"), Path("reports/video")
# what a policy from data alone reads in place of a world model and its rollouts, so that DVC has a file to name
NOTHING = (WORLD_MODELS / NO_WORLD_MODEL, ROLLOUTS / f"{NO_WORLD_MODEL}.h5")


def rollouts_file(root: Path, world_model: str) -> Path:
    """The rollouts that `generate_rollouts` stored in this world model."""
    return root / ROLLOUTS / f"{world_model}.h5"


def robot_of(params: Params) -> Robot | None:
    """The task's robot, or None where the data are of a robot of one's own."""
    return None if params.task is None else get_task(params.task).robot


def unseen(params: Params) -> dict[str, float]:
    """What policies must not see: where no simulator can score them, held-out actions have to."""
    return {"held_out": params.download.held_out} if params.task is None else {}


def run_settings(
    params: Params, options: WorldModelOptions | PolicyOptions | GenerateRolloutsOptions
) -> dict[str, Any]:
    """What a run's result depends on, beside its input files."""
    common = {name: getattr(params, name) for name in ("seed", "threads", "compile")}
    return common | {"precision": resolved(params.precision), "options": asdict(options)}


@contextlib.contextmanager
def run_stage(name: str, params: Params, root: Path) -> Iterator[None]:
    """Threads and seeds for a stage; its wall time and peak memory go to a side file that no hash covers."""
    torch.set_num_threads(params.threads)
    L.seed_everything(params.seed, verbose=False)
    begin = time.perf_counter()
    yield
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    note_timing(root, name, {"seconds": round(time.perf_counter() - begin, 1), "peak_memory_mb": round(peak)})


def note_timing(root: Path, name: str, value: Any) -> None:
    """Notes seconds or rates in `.envtf/timings.json`, a side file that no hash covers."""
    path, timings = root / ".envtf" / "timings.json", {}
    with contextlib.suppress(ValueError):  # a damaged side file is begun anew
        found = read_json(path) if path.exists() else {}
        timings = found if isinstance(found, dict) else {}
    with contextlib.suppress(ValueError):  # the work is done, whether this can be noted or not
        write_json(path, timings | {name: value})
