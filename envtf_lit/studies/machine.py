"""The machine of a measurement: its description, timing and memory on it, and the code that ran."""

import contextlib
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import torch

from envtf_lit.devices import pick_device, resolved
from envtf_lit.errors import UserError
from envtf_lit.options.schema import Precision

PACKAGES = ("torch", "lightning", "gymnasium", "mujoco", "numpy")


def bench_device(name: str | None) -> torch.device:
    """The named device, or by default the accelerator if there is one.

    Raises:
        UserError: torch does not know or have it.
    """
    if name is None:
        return pick_device()
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # an assertion where torch was built without it
        reason = str(error).splitlines()[0]
        raise UserError(f"No device {name!r} here ({reason}): leave --device out, or take cpu.") from None
    return device


def hardware(device: torch.device) -> dict[str, Any]:
    """The device by its name, and the CPU's cores."""
    named = getattr(torch.get_device_module(device), "get_device_name", None)
    return {
        "device": f"{device.type} ({platform.processor() or platform.machine()})" if named is None else named(device),
        "cores": os.cpu_count(),
    }


def facts(device: torch.device, precision: Precision) -> dict[str, Any]:
    """Device, threads, load and versions: what belongs beside every timing."""
    return {
        **hardware(device),
        "threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "precision": resolved(precision, device),
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
    }


def seconds(action: Callable[[], object], device: torch.device) -> float:
    """Wall time of an action, to the end of what it set going on the device."""
    synchronise(device)
    begin = time.perf_counter()
    action()
    synchronise(device)
    return time.perf_counter() - begin


def synchronise(device: torch.device) -> None:
    """Waits for the device; the CPU is never behind."""
    if device.type != "cpu":
        torch.accelerator.synchronize(device)


def in_turns(actions: dict[str, Callable[[], float]], rounds: int, *, warm_up: int = 1) -> list[dict[str, float]]:
    """Seconds of each action in each round, all of them in turn, after so many rounds that warm up.

    Whatever else the machine does then falls on all of them alike.
    """
    return [{name: action() for name, action in actions.items()} for _ in range(warm_up + rounds)][warm_up:]


def typical(rounds: list[dict[str, float]], name: str) -> float:
    """Median seconds of an action."""
    return median(values[name] for values in rounds)


def ratio(rounds: list[dict[str, float]], slow: str, fast: str) -> float:
    """How many times as long one action takes as another: the median of each round's own ratio."""
    return median(values[slow] / values[fast] for values in rounds)


def peak_memory_mb() -> float:
    """The most that this process has held in memory, MB (10^6 bytes).

    Linux tells it of the program itself; what `getrusage` says holds what whoever started the process had, too.
    """
    with contextlib.suppress(OSError):
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def code_version() -> str:
    """The commit that this package's code is of, with `-changed` behind it where files differ; else its version."""
    folder = Path(__file__).parent.parent

    def git(*words: str) -> str:
        call = ["git", "-C", str(folder), *words]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # not the repository that an environment happens to lie in
        return git("rev-parse", "--short=10", "HEAD") + ("-changed" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return version("envtf-lit")
