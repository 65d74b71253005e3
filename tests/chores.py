"""What jobs do in tests, in a module that a new process imports at once."""

import os
import signal
import time
from pathlib import Path

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
