"""Loading: milliseconds per batch, and the memory that a large log costs: `python benchmarks/loading.py [OUT.json]`.

Writes a log of 2,000,000 rows with the dimensions of Ant-105 (1.8 GB) and one of 20,000 into a temporary folder, and
trains the small preset's world model and agent on both, each in a process of its own. Prints the milliseconds that a
batch costs the loader and then the learner (the agent in its warm start, when it is quickest), in CPU time of one
thread, which other processes leave alone; how long the index of windows takes; and each process's peak memory,
anonymous and file-backed, as /proc/self/status has it (sampled every 20 ms; VmHWM is the kernel's own peak of the sum).
Rows are read from the file, not mapped: file-backed memory is that of the programs.
"""

import json
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from envtf_lit.agents.cql import CQL
from envtf_lit.data.columns import blocks
from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import Windows
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.pipeline.params import Params
from envtf_lit.training import trained
from envtf_lit.world_models.lit import LitWorldModel
from envtf_lit.world_models.options import ModelOptions, TransformerOptions

LARGE, SMALL = 2_000_000, 20_000
S, A, EPISODE = 105, 8, 1_000
WINDOW_BATCHES, ROW_BATCHES = 60, 6  # of 32 windows, of 10 x 256 rows


class Walk:
    """Column of a log that is made as it is read, so that a large one never lies in memory: noise that comes round."""

    dtype, ndim = np.dtype(np.float32), 2

    def __init__(self, rows: int, width: int, after: int) -> None:
        self.shape, self.after = (rows, width), after
        self.table = np.random.default_rng(0).uniform(-1, 1, (4096, width)).astype(np.float32)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.table[(np.arange(rows.start, rows.stop) + self.after) % len(self.table)]


def write_log(path: Path, rows: int) -> None:
    ends = np.arange(EPISODE - 1, rows, EPISODE)
    truncated = np.zeros(rows, bool)
    truncated[ends] = True
    wide: dict[str, Any] = {"observations": Walk(rows, S, 0), "next_observations": Walk(rows, S, 1)}
    dataset = OfflineDataset(
        **wide,
        actions=np.concatenate([Walk(rows, A, 0)[block] for block in blocks(rows, 8 * A)]),
        rewards=np.random.default_rng(0).normal(size=rows).astype(np.float32),
        terminated=np.zeros(rows, bool),
        truncated=truncated,
        episode_starts=np.arange(0, rows, EPISODE),
        action_low=-np.ones(A, np.float32),
        action_high=np.ones(A, np.float32),
    )
    save_dataset(dataset, path)


class Memory(threading.Thread):
    """The largest anonymous and file-backed memory seen, in MB."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak = dict.fromkeys(("RssAnon", "RssFile", "VmHWM"), 0)
        self.start()

    def run(self) -> None:
        while True:
            self.look()
            time.sleep(0.02)

    def look(self) -> dict[str, int]:
        lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
        seen = {words[0][:-1]: int(words[1]) // 1000 for words in lines if words[0][:-1] in self.peak}
        self.peak = {name: max(value, seen[name]) for name, value in self.peak.items()}
        return self.peak


def loading_ms(loader: Any, count: int) -> float:
    batches: Iterator[Any] = iter(loader)
    next(batches)
    begin = time.process_time()
    for _ in range(count - 1):
        next(batches)
    return 1000 * (time.process_time() - begin) / (count - 1)


def measure(path: Path, learner: str) -> dict[str, Any]:
    """Gives batches to nobody, then to a learner; in a process of its own."""
    memory, params = Memory(), Params()
    torch.set_num_threads(1)
    model, policy = params.train_model["transformer"], params.train_policy["cql"]
    assert isinstance(model, TransformerOptions)
    if learner == "world model":
        data = WindowData(str(path), model.context, model.batch_size, WINDOW_BATCHES, seed=0)
        module, steps = LitWorldModel(S, A, model), WINDOW_BATCHES
    else:
        data = TransitionData(str(path), policy.batch_size, ROW_BATCHES, n_step=policy.n_step)
        module, steps = CQL(S, A, policy), ROW_BATCHES
    data.setup("fit")
    loaded = loading_ms(data.train_dataloader(), steps)
    clock: list[float] = []
    setattr(module, "on_train_batch_end", lambda *_: clock.append(time.process_time()))  # noqa: B010 (a hook)
    with (
        tempfile.TemporaryDirectory() as folder,
        trained(
            module,
            data,
            run=Path(folder),
            target=None,
            epochs=1,
            precision=params.precision,
            progress=False,
            validate=False,
        ),
    ):
        pass
    learned = 1000 * (clock[-1] - clock[0]) / (len(clock) - 1) - loaded
    rates = {"loading_ms": loaded, "learning_ms": learned, "ratio": learned / loaded}
    return rates | {f"{name}_mb": value for name, value in memory.look().items()}


def index_seconds(path: Path, context: int) -> float:
    """To number the windows of a log of that size, per million rows."""
    dataset = load_dataset(path)
    begin = time.perf_counter()
    windows = Windows(dataset, context)
    windows.tiles()
    return (time.perf_counter() - begin) / len(dataset) * 1e6


def main(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = {"torch": torch.__version__, "machine": platform.machine()}
    for rows in (SMALL, LARGE):
        path = folder / f"{rows}.h5"
        write_log(path, rows)
        result[f"file_{rows}_mb"] = path.stat().st_size // 1_000_000
        for learner in ("world model", "agent"):
            command = [sys.executable, __file__, "--measure", str(path), learner]
            process = subprocess.run(command, capture_output=True, text=True, check=True)
            result[f"{learner}, {rows} rows"] = json.loads(process.stdout.splitlines()[-1])
    result["window_index_seconds_per_million_rows"] = index_seconds(folder / f"{LARGE}.h5", ModelOptions().context)
    for learner in ("world model", "agent"):
        large, small = (result[f"{learner}, {rows} rows"]["VmHWM_mb"] for rows in (LARGE, SMALL))
        result[f"{learner}, mb more for the large log"] = large - small
    return result


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measure(Path(sys.argv[2]), sys.argv[3])))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            text = json.dumps(main(Path(temporary)), indent=2)
        print(text)
        if len(sys.argv) > 1:
            Path(sys.argv[1]).write_text(text + "\n")
