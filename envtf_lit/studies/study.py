"""A study: one measurement of several world models on several robots, into one JSON file, a page and figures.

`run_study` trains the models that do not lie there yet, asks a `Study` for the finding of each, and writes the result
after every robot.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar, Generic, TypeVar

import torch

from envtf_lit.files import write_json
from envtf_lit.results import claim
from envtf_lit.robots.tasks import Task, get_task
from envtf_lit.studies.suite import (
    MODELS,
    WORK,
    Suite,
    SuiteOptions,
    add_model,
    build_suite,
    other_folders,
    result_header,
)
from envtf_lit.world_models.options import WorldModelOptions

SUITE = "suite"  # the part of the work on a robot that trains models; each model measured is a part of its own

Finding = TypeVar("Finding")


class Study(ABC, Generic[Finding]):
    """What is measured of a world model on a robot, a `Finding`, and how findings are shown.

    Attributes:
        options: a dataclass: how much is measured.
        prefix: of the options' names in the result.
        mark: a key that every result of this study has, and hardly any other file.
        variant: of the robots, `-hidden` or none; it ends the tasks' names.
    """

    options: Any
    prefix: ClassVar[str] = "measured"
    mark: ClassVar[str]
    variant: ClassVar[str] = ""

    def check(self, task: Task) -> None:  # most have nothing to refuse
        """Raises UserError for what cannot be measured on a task; called before any work."""

    @abstractmethod
    def measure(
        self, task: Task, suite: Suite, others: Mapping[str, Path], progress: bool
    ) -> Iterator[tuple[str, Finding]]:
        """Each model's name and finding, one after the other; those that were measured before are read from disk.

        Args:
            task: robot and tier.
            suite: data and models.
            others: folders of further models, by name.
            progress: shows bars.
        """

    @abstractmethod
    def headline(self, finding: Finding) -> str:
        """One line that says what matters of a finding."""

    @abstractmethod
    def numbers(self, findings: Mapping[str, Finding]) -> dict[str, Any]:
        """The result of one robot, by model: flat keys, which follow the robot's name in the file."""

    @abstractmethod
    def beside(self, out: Path) -> list[Path]:
        """The files that `show` writes beside the JSON file."""

    @abstractmethod
    def show(self, found: Mapping[str, Mapping[str, Finding]], tier: str, out: Path) -> None:
        """Writes page and figures of all findings, by robot and model, beside the JSON file."""


def run_study(
    study: Study[Finding],
    out: Path,
    *,
    robots: Sequence[str],
    tier: str,
    work: Path = WORK,
    options: SuiteOptions,
    models: Sequence[str] = MODELS,
    variants: Mapping[str, WorldModelOptions] | None = None,
    others: Mapping[str, str] | None = None,
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measures every model on every robot; what an interrupted call has trained or measured is kept below `work`.

    Args:
        study: what is measured.
        out: JSON file to write after each robot; the study's page and figures lie beside it.
        robots: names.
        tier: of the data that models are trained and measured on.
        work: folder of suites; what was trained or measured there before with the same options is used again.
        options: of the data and the models.
        models: which of the suite's.
        variants: models to train beside the suite's on the same data, name to options.
        others: further models, name to folder; `{task}` and `{robot}` in a folder stand for those names.
        progress: shows bars.
        report: called with a line for each thing done.

    Returns:
        What the file holds, under flat keys: `result_header`, and `ROBOT.` before `Suite.costs` and `Study.numbers`.

    Raises:
        UserError: an unknown robot or tier, an option out of range, a folder without a world model of the robot, a name
            that is taken, or a file in the way that is none of this study's.
    """
    tasks = [get_task(f"{robot}-{tier}{study.variant}") for robot in dict.fromkeys(robots)]
    variants, others = variants or {}, others or {}
    folders = other_folders(others, tasks)
    for task in tasks:
        study.check(task)
    claim(out, study.mark, study.beside(out))
    torch.set_num_threads(options.threads)
    clock = _Clock([SUITE, *models, *variants, *others], len(tasks), report)
    found: dict[str, dict[str, Finding]] = {}
    result = result_header(tier, options, **{study.prefix: study.options})
    for task in tasks:
        robot, suite = task.robot.name, build_suite(task.name, work, options, models=models, progress=progress)
        for name, train in variants.items():
            add_model(suite, name, train, progress=progress)
        clock.done(SUITE, f"{robot}: dataset and models")
        found[robot] = {}
        for name, finding in study.measure(task, suite, folders[task.name], progress):
            found[robot][name] = finding
            clock.done(name, f"{robot}: {name}: {study.headline(finding)}")
        result |= suite.costs | {f"{robot}.{key}": value for key, value in study.numbers(found[robot]).items()}
        write_json(out, result)
        study.show(found, tier, out)
    return result


class _Clock:
    """Reports what is done and about how long the rest takes, judged by the same part on other robots, or by any part.

    Args:
        parts: of the work on one robot.
        rounds: robots.
        report: is given the lines.
    """

    def __init__(self, parts: Sequence[str], rounds: int, report: Callable[[str], None]) -> None:
        self.rounds, self.left = rounds, dict.fromkeys(parts, rounds)
        self.report, self.begin = report, time.perf_counter()
        self.seconds: dict[str, list[float]] = {}

    def done(self, part: str, line: str) -> None:
        """Notes that a part is done; one that lay there already tells nothing about the rest."""
        elapsed, self.begin = time.perf_counter() - self.begin, time.perf_counter()
        self.left[part] = self.left.get(part, self.rounds) - 1
        if elapsed > 1.0:
            self.seconds.setdefault(part, []).append(elapsed)
        every = [value for values in self.seconds.values() for value in values] or [0.0]
        left = sum(count * fmean(self.seconds.get(name, every)) for name, count in self.left.items())
        self.report(f"{line} ({elapsed:.0f} s; about {left / 60:.0f} min left)")
