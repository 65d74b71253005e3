"""What the runs of a task share, made once: its dataset, a cloned policy, world models and their first rollouts."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from envtf_lit.comparison.budgets import Budget
from envtf_lit.comparison.records import DATASET, Shared, alone
from envtf_lit.comparison.settings import CLONE, shared_params
from envtf_lit.data.sources.fetch import sha256
from envtf_lit.files import write_json
from envtf_lit.pipeline import stage
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.results import has, read_or_none
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies.machine import peak_memory_mb
from envtf_lit.studies.suite import WORDS
from envtf_lit.zoo.snapshots import describe_origin

WORK = Path(".envtf/comparison")  # where it is kept, unless told otherwise


@dataclass(frozen=True)
class Home:
    """The folder of what the runs of a task share, laid out as a project.

    Attributes:
        task: robot and tier.
        budget: of the runs; those that differ in their policies' updates alone have one home.
        work: folder of all homes.
    """

    task: str
    budget: Budget
    work: Path

    @property
    def path(self) -> Path:
        """Where it lies."""
        b = self.budget
        return self.work / self.task / f"{b.rows}_rows-seed_{b.data_seed}-{b.preset}-{b.model_updates}_updates"

    def make(self, made: str) -> Shared:
        """Makes the dataset, or a world model on it with its first rollouts; what lies there made alike is kept.

        Args:
            made: `dataset`, or the world model's name.

        Raises:
            UserError: what the stages raise.
        """
        work = self._make_dataset if made == DATASET else lambda: self._make_model(made)
        return self._row(made, _once(self._record(made), self._settings(made), work))

    def found(self, made: str) -> Shared | None:
        """What `make` would keep, or None where there is work to do."""
        if made != DATASET and self.found(DATASET) is None:
            return None
        facts = _done(self._record(made), self._settings(made))
        return None if facts is None else self._row(made, facts)

    def _row(self, made: str, facts: dict[str, Any]) -> Shared:
        task = get_task(self.task)
        return Shared(task.robot.name, task.tier, str(self.budget), made, **facts)

    def _record(self, made: str) -> Path:
        return self.path / "made" / f"{made}.json"

    def _settings(self, made: str) -> dict[str, Any]:
        """All that the result depends on."""
        if made == DATASET:
            origin = describe_origin(get_task(self.task), self.budget.rows, self.budget.data_seed)
            return _plain({name: value for name, value in origin.items() if name not in WORDS})
        params, data = shared_params(self.task, self.budget, made), {"dataset": sha256(self.path / stage.DATASET)}
        if made == CLONE:
            return _plain(data | stage.run_settings(params, params.train_policy[made]))
        rollouts = asdict(params.generate_rollouts)
        return _plain(data | stage.run_settings(params, params.train_model[made]) | {"rollouts": rollouts})

    def _make_dataset(self) -> dict[str, Any]:
        card = download(shared_params(self.task, self.budget), self.path, progress=False)
        mean, best = card["scores"]["mean"], card["scores"]["max"]
        size = {name: card[name] for name in ("transitions", "episodes")}
        return size | {"score_mean": round(mean, 3), "score_best": round(best, 3)}

    def _make_model(self, name: str) -> dict[str, Any]:
        params = shared_params(self.task, self.budget, name)
        train_model(params, self.path, name=name, progress=False)
        _once(self._record(CLONE), self._settings(CLONE), lambda: self._make_clone(name))
        generate_rollouts(params, self.path, name=name, progress=False)
        return {}

    def _make_clone(self, model: str) -> dict[str, Any]:
        train_policy(shared_params(self.task, self.budget, model), self.path, name=CLONE, progress=False)
        return {}


def _once(record: Path, settings: dict[str, Any], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Does some work unless it was done with the same settings; a process that comes meanwhile waits for it.

    Args:
        record: JSON that says with what settings it was done.
        settings: as JSON has them.
        work: returns what is to be noted of it.

    Returns:
        Seconds that it took, the process's memory, and what it noted.
    """
    with alone(record):
        if (done := _done(record, settings)) is not None:
            return done
        record.unlink(missing_ok=True)  # what it is about is going to be replaced
        begin = time.perf_counter()
        found = work()
        facts = {"seconds": round(time.perf_counter() - begin, 1), "memory_mb": round(peak_memory_mb(), 1)} | found
        write_json(record, {"settings": settings, "facts": facts})
        return facts


def _done(record: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    found = read_or_none(record)
    return found["facts"] if has(found, "settings", "facts") and found["settings"] == settings else None


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """As JSON has them, with lists for tuples."""
    return json.loads(json.dumps(values))
