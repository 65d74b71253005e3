"""The measurements: of horizons, calibration, hidden dynamics, harm from narrow logs, speed and cost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from envtf_lit.cli.output import console, hush_lightning
from envtf_lit.cli.signatures import CORES, File, Folder, Natural, Positive, Robot, run_command
from envtf_lit.errors import UserError
from envtf_lit.options.schema import Precision

if TYPE_CHECKING:
    from envtf_lit.studies.suite import SuiteOptions

Models = Annotated[tuple[str, ...], "NAME=FOLDER"]
Device = Annotated[str, "NAME"]
Program = Annotated[Path, "PYTHON"]

Log = Literal["governed", "plain", "clock", "expert", "walker2d"]  # written out, as robots are

LOGS: tuple[Log, ...] = ("governed", "plain", "clock", "expert", "walker2d")
ROBOTS: tuple[Robot, ...] = ("hopper", "halfcheetah", "walker2d", "ant")


@dataclass(frozen=True)
class Training:
    """What a command that compares the suite of world models is asked for; it trains those that are not there.

    Attributes:
        work: where they lie.
        transitions: rows of data.
        updates: of the transformers.
        windows: of --context steps per update of theirs.
        ensemble_updates: of the ensemble at most.
        context: steps.
        seed: of everything random.
        threads: CPU threads.
        compile: run them through torch.compile, which pays on a GPU.
        quiet: no progress bars.
    """

    work: Folder = Path(".envtf/suite")
    transitions: Natural = 100_000
    updates: Natural = 6_000
    windows: Positive = 32
    ensemble_updates: Positive = 100_000
    context: Natural = 16
    seed: Natural = 0
    threads: Natural = CORES
    compile: bool = False
    quiet: bool = False

    def options(self) -> "SuiteOptions":
        """What the suite is made with."""
        from envtf_lit.studies.suite import SuiteOptions
        from envtf_lit.world_models.options import EnsembleOptions

        names = ("transitions", "updates", "windows", "context", "seed", "threads", "compile")
        most = self.ensemble_updates
        ensemble = EnsembleOptions(updates=most, updates_per_epoch=min(EnsembleOptions().updates_per_epoch, most))
        return SuiteOptions(ensemble=ensemble, **{name: getattr(self, name) for name in names})

    def comparison(self) -> dict[str, Any]:
        """Arguments of every `run_study`."""
        return dict(work=self.work, options=self.options(), progress=not self.quiet, report=console().print)


SHORT = Training()
LONG = Training(context=32)


def hidden(
    *,
    out: File,
    robots: tuple[Robot, ...] = ("halfcheetah", "walker2d"),
    tier: str = "medium-replay",
    unseen: Natural = 100_000,
    training: Training = LONG,
) -> None:
    """Measures what memory is worth where friction, mass and strength are hidden.

    Args:
        out: JSON; the figure lies beside it.
        robots: which of the four.
        tier: of the data.
        unseen: rows to measure on.
        training: of the suite.
    """
    from envtf_lit.studies.memory import HiddenOptions, MemoryStudy
    from envtf_lit.studies.study import run_study

    run_study(MemoryStudy(HiddenOptions(unseen)), out, robots=robots, tier=tier, **training.comparison())


def horizon(
    *,
    out: File,
    robots: tuple[Robot, ...] = ROBOTS,
    tier: str = "medium-replay",
    trajectories: Natural = 300,
    online: Natural = 100,
    start: Natural = 0,
    model: Models = (),
    training: Training = SHORT,
) -> None:
    """Measures how long world models track reality, beside the ceiling that physics sets.

    Args:
        out: JSON; a table and a folder of figures lie beside it.
        robots: which of the four.
        tier: of the data.
        trajectories: fresh episodes with recorded actions.
        online: fresh episodes of each online policy.
        start: steps of each episode to leave out.
        model: a further world model; {task} and {robot} in the folder stand for their names; may be repeated.
        training: of the suite.
    """
    others = _named_folders(model)
    from envtf_lit.studies.horizon import HorizonOptions, HorizonStudy
    from envtf_lit.studies.study import run_study

    study = HorizonStudy(HorizonOptions(trajectories, online, start))
    run_study(study, out, robots=robots, tier=tier, others=others, **training.comparison())


def calibrate(
    *,
    out: File,
    robots: tuple[Robot, ...] = ROBOTS,
    tier: str = "medium",
    model: Models = (),
    training: Training = SHORT,
) -> None:
    """Measures what world models know of their own errors.

    Args:
        out: JSON; a table and a figure lie beside it.
        robots: which of the four.
        tier: of the data.
        model: a further world model; {task} and {robot} in the folder stand for their names; may be repeated.
        training: of the suite.
    """
    others = _named_folders(model)
    from envtf_lit.studies.calibration import CalibrationStudy
    from envtf_lit.studies.study import run_study

    run_study(CalibrationStudy(), out, robots=robots, tier=tier, others=others, **training.comparison())


def narrow(
    *,
    out: File,
    logs: tuple[Log, ...] = LOGS,
    seeds: Positive = 5,
    episodes: Positive = 10,
    trust: Literal["cautious", "default", "bold"] = "default",
    preset: Literal["tiny", "small", "base"] = "small",
    work: Folder = Path(".envtf/narrow"),
    threads: Positive = CORES,
    quiet: bool = False,
) -> None:
    """Measures whether policies from logs of machines that were held back do harm.

    Args:
        out: JSON; a table lies beside it.
        logs: which of the five.
        seeds: of training, on each log.
        episodes: of each policy in the log's true simulator.
        trust: how far policies may leave the log.
        preset: sizes and budgets.
        work: where logs and models lie.
        threads: CPU threads.
        quiet: no progress bars.
    """
    from envtf_lit.pipeline.yaml import preset_params
    from envtf_lit.studies.narrow import NarrowOptions, run_narrow
    from envtf_lit.studies.narrow_logs import MACHINES

    run_narrow(
        out,
        params=replace(preset_params(preset), threads=threads),
        machines={name: MACHINES[name] for name in logs},
        trust=trust,
        options=NarrowOptions(seeds=seeds, episodes=episodes),
        work=work,
        progress=not quiet,
        report=console().print,
    )


def _named_folders(texts: Sequence[str]) -> dict[str, str]:
    """What the flags `--model` say."""
    found = dict[str, str]()
    for text in texts:
        name, _, folder = text.partition("=")
        if not (name and folder):
            raise UserError(f"--model {text!r} has no name and folder: write --model NAME=FOLDER.")
        found[name] = folder
    return found


def bench_model(
    *,
    preset: str = "small",
    device: Device | None = None,
    precision: Precision = "auto",
    compile: bool = False,
    windows: Positive | None = None,
    batch: Positive = 4_096,
    horizon: Positive = 5,
    rounds: Positive = 5,
    seed: Natural = 0,
    threads: Positive = CORES,
    out: File | None = None,
) -> None:
    """Measures the world model's speed.

    Args:
        preset: tiny, small, base or paper.
        device: such as cpu; default: the accelerator if there is one.
        precision: of both sides.
        compile: run all models through torch.compile.
        windows: of a gradient step; default: the preset's.
        batch: rollouts at a time.
        horizon: steps of each.
        rounds: of which medians are reported.
        seed: of everything random.
        threads: CPU threads.
        out: JSON.
    """
    from envtf_lit.studies import speed

    result = speed.bench_model(
        out,
        preset=preset,
        device=device,
        precision=precision,
        compile=compile,
        threads=threads,
        windows=windows,
        batch=batch,
        horizon=horizon,
        rounds=rounds,
        seed=seed,
    )
    console().print_json(data=result)


def bench_agents(
    *,
    d3rlpy: Program | None = None,
    updates: Positive = 100,
    rounds: Positive = 5,
    threads: Positive = 1,
    out: File | None = None,
) -> None:
    """Measures the speed of the agents' updates on a CPU.

    Args:
        d3rlpy: of an environment with d3rlpy, made by `python -m venv .d3rlpy` and `.d3rlpy/bin/python -m pip install
            -r benchmarks/d3rlpy/requirements.txt`; without it the ratios against d3rlpy are null.
        updates: of each algorithm in a round, a multiple of 100; CQL with ten sampled actions takes a tenth of them.
        rounds: of which medians are reported.
        threads: CPU threads of either side.
        out: JSON.
    """
    from envtf_lit.studies import agent_speed

    result = agent_speed.bench_agents(out, d3rlpy=d3rlpy, updates=updates, rounds=rounds, threads=threads)
    console().print_json(data=result)


def bench_cost(*, task: str = "hopper-medium-replay", training: Training = SHORT, out: File | None = None) -> None:
    """Measures what the world model's accuracy costs.

    Args:
        task: robot and tier.
        training: of the models.
        out: JSON.
    """
    from envtf_lit.studies import cost

    options, progress = training.options(), not training.quiet
    console().print_json(data=cost.bench_cost(out, task=task, work=training.work, options=options, progress=progress))


FUNCTIONS = {
    "hidden": hidden,
    "horizon": horizon,
    "calibrate": calibrate,
    "narrow": narrow,
    "bench model": bench_model,
    "bench agents": bench_agents,
    "bench cost": bench_cost,
}


def run(name: str, words: Sequence[str]) -> None:
    """Runs one of the measurements."""
    hush_lightning()
    run_command(FUNCTIONS[name], name, words)
