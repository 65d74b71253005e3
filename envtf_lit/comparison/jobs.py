"""Jobs that wait for others, and the processes of one machine that do them; `cluster` has the same for Ray."""

import contextlib
import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from envtf_lit.errors import UserError
from envtf_lit.workers import end_with_parent

PATIENCE = 5.0  # seconds that a process is given to end by itself


@dataclass(frozen=True)
class Job:
    """Something to be done in a process of its own.

    Attributes:
        name: in words, unlike any other job's.
        kind: of jobs that take about as long.
        function: of a module, so that another process finds it.
        arguments: of it; they can be pickled, as can what it returns.
        log: file for what it prints.
        after: names of jobs that must have been done before.
    """

    name: str
    kind: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    log: Path
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What a job returned, or a sentence that says why it failed.

    Attributes:
        value: that it returned.
        error: None where it did not fail.
        seconds: that it took.
    """

    value: Any = None
    error: str | None = None
    seconds: float = 0.0


Done = Generator[tuple[Job, Outcome]]


def attempt(job: Job) -> Outcome:
    """Does a job in this process; what it prints goes to its log, and so does the traceback of a fault of ours."""
    begin = time.perf_counter()
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("w") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        try:
            value = job.function(*job.arguments)
            return Outcome(value, seconds=time.perf_counter() - begin)
        except UserError as error:
            return Outcome(error=str(error))
        except Exception as error:  # of this job alone: the others go on
            traceback.print_exc()
            return Outcome(error=f"{type(error).__name__}: {error} (see {job.log})")


def failed(job: Job, cause: str) -> Outcome:
    """Of a job that waited for another, which failed."""
    return Outcome(error=f"{cause} failed, which it needs")


def run_jobs(jobs: Sequence[Job], workers: int) -> Done:
    """Does jobs in processes of this machine, so many at a time, and yields each as it is done.

    Each has a fresh process, so that the memory it is seen to hold is its own. The first job in the list that can be
    done is begun first. Whoever stops listening ends the processes.

    Args:
        jobs: those that others wait for come before them.
        workers: processes at a time.
    """
    waiting, done, lost = list(jobs), set[str](), set[str]()
    running: dict[Connection, tuple[Job, SpawnProcess]] = {}
    try:
        while waiting or running:
            for job in [job for job in waiting if lost & set(job.after)]:
                waiting.remove(job)
                lost.add(job.name)
                yield job, failed(job, next(name for name in job.after if name in lost))
            ready = [job for job in waiting if done >= set(job.after)]
            for job in ready[: workers - len(running)]:
                waiting.remove(job)
                running |= [_start(job)]
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                job, process = running.pop(connection)
                outcome = _receive(connection, process)
                (done if outcome.error is None else lost).add(job.name)
                yield job, outcome
    finally:
        for _, process in running.values():
            process.terminate()
        for connection, (_, process) in running.items():
            process.join(PATIENCE)
            process.kill()  # one that is in the midst of a long step
            process.join()
            connection.close()


def _start(job: Job) -> tuple[Connection, tuple[Job, SpawnProcess]]:
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, job), daemon=False)
    process.start()
    theirs.close()  # so that the process's end ends the pipe
    return ours, (job, process)


def _work(connection: Connection, job: Job) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's goes to all: who started this ends it
    connection.send(attempt(job))
    connection.close()


def _receive(connection: Connection, process: SpawnProcess) -> Outcome:
    try:
        outcome = connection.recv()
    except EOFError:
        process.join()
        code = process.exitcode or 0
        how = f"was ended by signal {-code}" if code < 0 else f"ended with status {code}"
        outcome = Outcome(error=f"its process {how}; free some memory, or use fewer workers")
    process.join()
    connection.close()
    return outcome
