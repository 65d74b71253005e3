"""Processes that begin with all of the package imported: forks of one that has done nothing else.

To import it takes longer than most of what a tutorial does at its tiny size. Each is a process of its own all the same,
with its own modules, folder and environment.
"""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any

from envtf_lit.cli.main import main
from envtf_lit.workers import end_with_parent

PROGRAM = [sys.executable, "-m", "envtf_lit"]
IMPORTED = [
    "envtf_lit.cli.lightning",
    "envtf_lit.comparison.cell",
    "envtf_lit.figures.report",
    "envtf_lit.pipeline.download",
    "envtf_lit.pipeline.evaluate",
    "envtf_lit.studies.planning",
    "envtf_lit.zoo.collect",
    "ipykernel.kernelapp",
]


@cache
def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(IMPORTED)
    return context


class Forked:
    """What of `subprocess.Popen` a kernel's manager uses."""

    stdin = stdout = stderr = None

    def __init__(self, process: ForkServerProcess) -> None:
        self.process, self.pid = process, process.pid

    def poll(self) -> int | None:
        return self.process.exitcode

    def wait(self) -> int | None:
        self.process.join()
        return self.process.exitcode

    def send_signal(self, number: int) -> None:
        assert self.pid is not None
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def launch_kernel(command: Sequence[str], *, env: Mapping[str, str], cwd: str | None = None, **_: Any) -> Forked:
    """As jupyter_client's function of that name; what the kernel runs of `envtf` is a warm process, too."""
    ours, theirs = _context().Pipe()
    process = _context().Process(target=_kernel, args=(theirs, list(command), dict(env), cwd))
    process.start()
    theirs.close()
    ours.recv()  # has a group of its own, which is killed in the end
    ours.close()
    return Forked(process)


def _kernel(ready: Connection, command: list[str], environment: dict[str, str], folder: str | None) -> None:
    _begin(environment, folder)
    os.setsid()
    ready.send(None)
    vars(subprocess)["run"] = _run
    _shorten()
    from ipykernel import kernelapp

    kernelapp.launch_new_instance(argv=[*command[3:], f"--IPKernelApp.parent_handle={os.getppid()}"])


def _begin(environment: Mapping[str, str], folder: str | None = None) -> None:
    assert {*IMPORTED} <= sys.modules.keys()
    end_with_parent()
    os.environ.clear()
    os.environ.update(environment)
    if folder is not None:
        os.chdir(folder)


def _shorten() -> None:
    """As for the tests of what is called here: short promises, and tiny networks in the runs of the comparison."""
    from envtf_lit.comparison import settings
    from envtf_lit.imagination import promise
    from tests.made_up_comparison import tiny_networks

    promise.LONGEST = 30
    settings._preset = tiny_networks


_subprocess_run = subprocess.run


def _run(command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """As `subprocess.run`, of `envtf` in a warm process."""
    if list(command[:3]) != PROGRAM:
        return _subprocess_run(command, **options)
    assert options.pop("capture_output") and {*options} <= {"check", "text"}
    with tempfile.TemporaryDirectory() as folder:
        written = [Path(folder) / name for name in ("stdout", "stderr")]
        process = _context().Process(target=_envtf, args=(list(command[3:]), dict(os.environ), written))
        process.start()
        process.join()
        said = [path.read_text("utf-8") for path in written]
    done = subprocess.CompletedProcess(command, process.exitcode or 0, *said)
    if options.get("check"):
        done.check_returncode()
    return done


def _envtf(arguments: list[str], environment: dict[str, str], written: Sequence[Path]) -> None:
    _begin(environment)
    with contextlib.ExitStack() as stack:
        for path, stream in zip(written, (sys.stdout, sys.stderr), strict=True):
            os.dup2(stack.enter_context(path.open("wb")).fileno(), stream.fileno())
        main(arguments)
