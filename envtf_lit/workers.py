"""Worker processes that end when whoever started them does, however that ended."""

import os
import threading
from multiprocessing import connection, parent_process


def end_with_parent() -> None:
    """Given to a pool as its initializer: the process ends as soon as the one that started it is gone.

    A process that is killed (SIGKILL, or the kernel's for memory) can tell nobody, and its workers would go on with
    what they had begun, for minutes, and then wait for ever. Only the main process may hold the pipe that is watched,
    as with the start method `spawn`.
    """
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_wait, args=(parent.sentinel,), daemon=True).start()


def _wait(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)  # nobody is left who would wait for more
