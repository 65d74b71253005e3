"""What a bug report needs to know of a machine."""

import os
import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

PACKAGES = (
    "envtf-lit",
    "torch",
    "lightning",
    "gymnasium",
    "mujoco",
    "numpy",
    "h5py",
    "dvc",
    "papermill",
    "jsonargparse",
)
MUJOCO = ("mujoco", "mujoco-core", "mujoco-studio")  # one package up to version 3


def report() -> dict[str, str]:
    """Versions, threads, memory, disk, accelerator and the working GL back end, each as a short text."""
    return {
        "platform": f"{platform.platform()}, {platform.machine()}",
        "python": f"{platform.python_version()} in {sys.prefix}",
        **{package: _version(package) for package in PACKAGES},
        **_torn_mujoco(),
        **_torch(),
        "memory": f"{_memory_gib():.1f} GiB",
        "disk here": "{2:.1f} of {0:.1f} GiB free".format(*(x / 2**30 for x in shutil.disk_usage("."))),
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "not set"),
        "rendering": _rendering(),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def _torn_mujoco() -> dict[str, str]:
    """The cure, if pip upgraded MuJoCo in place from 3: with the old package it removes files just laid by the new."""
    try:
        core = distribution("mujoco-core")
    except PackageNotFoundError:
        return {}
    lost = [file for file in core.files or () if file.suffix != ".pyc" and not Path(file.locate()).exists()]
    if not lost:
        return {}
    pins = " ".join(f"{package}=={core.version}" for package in MUJOCO)
    return {
        "mujoco": f"{core.version}, broken: {len(lost)} files of mujoco-core are missing, as after an upgrade from "
        f"MuJoCo 3; install it anew: pip install --force-reinstall --no-deps {pins}"
    }


def _torch() -> dict[str, str]:
    import torch

    from envtf_lit.devices import pick_device, resolved

    device = pick_device()
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    return {
        "cores": f"{_usable_cores()} usable of {os.cpu_count()}",
        "torch threads": f"{torch.get_num_threads()} (OMP_NUM_THREADS {os.environ.get('OMP_NUM_THREADS', 'not set')})",
        "device": f"{device} {name}".strip(),
        "precision": f"auto is {resolved('auto', device)} here",
    }


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _rendering() -> str:
    os.environ.pop("MUJOCO_GL", None)  # a back end that is missing breaks `import mujoco`
    from envtf_lit.figures.video import working_backend

    backend = working_backend()
    return "no GL works: videos show the links as lines" if backend == "disabled" else backend
