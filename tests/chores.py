"""What jobs do in tests, in a module that a new process imports at once."""

import os
import signal
import time
from pathlib import Path
from typing import Any

from envtf_lit.comparison.jobs import Job
from envtf_lit.errors import UserError


def sleep_and_note(folder: Path, name: str, seconds: float) -> int:
    """Writes when it began and when it ended; returns its process."""
    begin = time.time()
    time.sleep(seconds)
    (folder / name).write_text(f"{begin} {time.time()}")
    return os.getpid()


def end_itself(folder: Path) -> None:
    """As the kernel does for memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def complain(folder: Path) -> None:
    """Refuses, as for something that the user can mend."""
    print("on the way")
    raise UserError("This was asked for.")


def stumble(folder: Path) -> None:
    """Fails by a fault of its own."""
    raise ZeroDivisionError("by nought")


def job(folder: Path, name: str, function: Any = sleep_and_note, *given: Any, after: tuple[str, ...] = ()) -> Job:
    """One of these chores as a job, with a log of its own."""
    arguments = given if function is sleep_and_note else (folder,)
    return Job(name, "any", function, arguments, folder / f"{name}.log", after)
