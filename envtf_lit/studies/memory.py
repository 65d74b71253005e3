"""The study `envtf hidden`: the worth of memory, where a robot's friction, mass and strength are hidden."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.devices import pick_device
from envtf_lit.evaluation.in_context import InContextError, in_context_error, in_context_metrics, stretches
from envtf_lit.figures.in_context import in_context_curves
from envtf_lit.robots.tasks import Task
from envtf_lit.studies.study import Study
from envtf_lit.studies.suite import Suite, cached_result, flat_settings, load_for_study
from envtf_lit.world_models.forecast import Scale
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import plan

UNSEEN_SEED = 1_000_000  # added to the suite's seed: no draw of its data comes again


@dataclass(frozen=True)
class HiddenOptions:
    """The amount of test data.

    Attributes:
        unseen: transitions collected, of robots that no model was trained on.
        stretches: of those, drawn at random.
    """

    unseen: int = 100_000
    stretches: int = 2_000


@dataclass(frozen=True)
class MemoryStudy(Study[InContextError]):
    """Errors of each model by the steps of history it was shown, on draws of hidden dynamics that none has seen."""

    options: HiddenOptions = HiddenOptions()
    mark: ClassVar[str] = "measured.unseen"
    variant: ClassVar[str] = "-hidden"

    def check(self, task: Task) -> None:
        plan(task, self.options.unseen)

    def measure(
        self, task: Task, suite: Suite, others: Mapping[str, Path], progress: bool
    ) -> Iterator[tuple[str, InContextError]]:
        unseen, device = _unseen(task, suite, self.options.unseen, progress), pick_device()
        settings = flat_settings(task.tier, suite.options, measured=self.options)
        scale = Scale.of(suite.split()[0], device)
        trajectories = stretches(load_dataset(unseen), self.options.stretches, seed=suite.options.seed).to(device)

        def one(folder: Path) -> dict[str, Any]:
            return asdict(in_context_error(load_for_study(folder, suite.options), trajectories, scale))

        for name, folder in (suite.folders | dict(others)).items():
            inputs = [suite.dataset, unseen, folder]
            found = cached_result(suite.home, f"hidden-{name}", settings, inputs, partial(one, folder))
            yield name, InContextError(**found)

    def headline(self, finding: InContextError) -> str:
        one_step, open_loop = finding.summary
        return f"nmse {one_step:.3g} one step ahead, {open_loop:.3g} at the end of the open loop"

    def numbers(self, findings: Mapping[str, InContextError]) -> dict[str, Any]:
        return in_context_metrics(findings)

    def beside(self, out: Path) -> list[Path]:
        return [out.with_suffix(".png"), out.with_suffix(".csv")]

    def show(self, found: Mapping[str, Mapping[str, InContextError]], tier: str, out: Path) -> None:
        in_context_curves(found, out.with_suffix(".png"))


def _unseen(task: Task, suite: Suite, transitions: int, progress: bool) -> Path:
    """A file of episodes of new draws, named by what made them."""
    seed = suite.options.seed + UNSEEN_SEED
    path = suite.dataset.with_name(f"unseen-{transitions}-{seed}.h5")
    if not path.exists():
        save_dataset(collect(task, transitions, seed=seed, workers=suite.options.threads, progress=progress), path)
    return path
