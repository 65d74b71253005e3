"""Latency of an exported policy and world model on one core, beside PyTorch's: `python benchmarks/exported.py`.

    python benchmarks/exported.py models/policy/et_cql models/world_model/transformer

Each is called 200 times after 20 calls of warming up, for one row and for 256; printed are medians of milliseconds of
CPU time of one thread, which other processes leave alone. The world model steps on, its context full. PyTorch and
onnxruntime take turns.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import onnxruntime
import torch
from torch import Tensor

from envtf_lit.export import export_policy, export_world_model
from envtf_lit.policy import load_policy
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.step_graph import step_graph
from envtf_lit.world_models.store import load_world_model

CALLS, WARM_UP, ROWS = 200, 20, (1, 256)


def session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def milliseconds(*calls: Callable[[], object]) -> list[float]:
    """Medians of each, called in turns."""
    times: list[list[float]] = [[] for _ in calls]
    for number in range(WARM_UP + CALLS):
        for call, seen in zip(calls, times, strict=True):
            start = time.thread_time()
            call()
            if number >= WARM_UP:
                seen.append(1e3 * (time.thread_time() - start))
    return [median(seen) for seen in times]


class Stepping:
    """A rollout that sees the same state at every step."""

    def __init__(self, model: WorldModel, state: Any, observation: Tensor, action: Tensor) -> None:
        self.model, self.state, self.observation, self.action = model, state, observation, action

    def __call__(self) -> None:
        state, _ = self.model.step(self.state, self.action)
        self.state = self.model.observe(state, self.observation)


def policy_latency(folder: str, scratch: Path) -> None:
    policy = load_policy(folder)
    export_policy(policy, scratch / "policy.onnx")
    run = session(scratch / "policy.onnx").run
    for rows in ROWS:
        observation = policy.observation_mean + torch.randn(rows, len(policy.observation_mean))
        given = {"observation": observation.numpy(), "noise": torch.zeros(rows, len(policy.action_low)).numpy()}
        times = milliseconds(partial(policy.act, observation), partial(run, ["action"], given))
        print("policy, {} rows: PyTorch {:.3f} ms, onnxruntime {:.3f} ms".format(rows, *times))


def model_latency(folder: str, scratch: Path) -> None:
    model = load_world_model(folder)
    export_world_model(model, scratch / "model.onnx")
    run = session(scratch / "model.onnx").run
    for rows in ROWS:
        action = torch.zeros(rows, model.action_dim)
        observation = model.normaliser.observation_mean.expand(rows, -1).contiguous()
        state = model.init(observation[:, None], torch.zeros(rows, 0, model.action_dim), torch.ones(rows).long())
        noise = torch.zeros(rows, model.observation_dim + 1)
        carried = {"observation": observation, "action": action, "noise": noise} | step_graph(model).start(rows)
        given = {name: value.numpy() for name, value in carried.items()}
        if "clock" in given:
            given["clock"] += 10**3  # all slots count

        step, exported = Stepping(model, state, observation, action), partial(run, None, given)
        with torch.no_grad():
            times = milliseconds(step, exported)
        print("model, {} rows: PyTorch {:.3f} ms, onnxruntime {:.3f} ms".format(rows, *times))


if __name__ == "__main__":
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        policy_latency(sys.argv[1], Path(scratch))
        model_latency(sys.argv[2], Path(scratch))
