"""Jobs of the comparison: processes that wait for one another, fail and end."""

import multiprocessing
import os
from pathlib import Path

from envtf_lit.comparison.jobs import run_jobs
from tests.chores import complain, end_itself, job, sleep_and_note, stumble


def test_jobs_wait_for_what_they_need_and_each_has_its_process(tmp_path: Path) -> None:
    jobs = [
        job(tmp_path, "a", sleep_and_note, tmp_path, "a", 0.2),
        job(tmp_path, "b", sleep_and_note, tmp_path, "b", 0.0, after=("a",)),
        job(tmp_path, "c", sleep_and_note, tmp_path, "c", 0.0),
    ]
    done = {of.name: outcome for of, outcome in run_jobs(jobs, 2)}
    assert done.keys() == {"a", "b", "c"} and all(outcome.error is None for outcome in done.values())
    assert len({outcome.value for outcome in done.values()} | {os.getpid()}) == 4
    assert float((tmp_path / "b").read_text().split()[0]) >= float((tmp_path / "a").read_text().split()[1])
    assert done["a"].seconds >= 0.2


def test_a_job_that_fails_takes_those_along_that_need_it_and_no_others(tmp_path: Path) -> None:
    jobs = [
        job(tmp_path, "lost", end_itself),
        job(tmp_path, "needs it", sleep_and_note, tmp_path, "x", 0.0, after=("lost",)),
        job(tmp_path, "needs that", sleep_and_note, tmp_path, "x", 0.0, after=("needs it",)),
        job(tmp_path, "refused", complain),
        job(tmp_path, "faulty", stumble),
        job(tmp_path, "fine", sleep_and_note, tmp_path, "fine", 0.0),
    ]
    errors = {of.name: outcome.error for of, outcome in run_jobs(jobs, 1)}
    assert errors["lost"] == "its process was ended by signal 9; free some memory, or use fewer workers"
    assert errors["needs it"] == "lost failed, which it needs"
    assert errors["needs that"] == "needs it failed, which it needs"
    assert errors["refused"] == "This was asked for."
    assert errors["faulty"] == f"ZeroDivisionError: by nought (see {tmp_path / 'faulty.log'})"
    assert errors["fine"] is None
    assert (tmp_path / "refused.log").read_text() == "on the way\n"
    assert "in stumble" in (tmp_path / "faulty.log").read_text()
    assert not (tmp_path / "x").exists()


def test_whoever_stops_listening_ends_the_processes(tmp_path: Path) -> None:
    jobs = [
        job(tmp_path, "a", sleep_and_note, tmp_path, "a", 0.0),
        job(tmp_path, "b", sleep_and_note, tmp_path, "b", 60.0),
    ]
    running = run_jobs(jobs, 2)
    assert next(running)[0].name == "a"
    running.close()
    assert multiprocessing.active_children() == []
    assert not (tmp_path / "b").exists()
