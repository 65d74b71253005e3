"""The command line, `envtf`: a command per stage, Lightning's own command lines, and what helps around them."""

import argparse
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from textwrap import fill
from typing import Any

from envtf_lit.errors import DISK_FULL, UserError

# what each stage does, and the parts of params.yaml that its help explains
STAGES = {
    "download": ("Make or read the dataset: data/dataset.h5", ["download"]),
    "train_model": ("Train the world model: models/world_model/", ["train_model"]),
    "generate_rollouts": (
        "Clone the behaviour and imagine first rollouts: models/behaviour/, data/rollouts.h5",
        ["generate_rollouts"],
    ),
    "train_policy": ("Train a policy: models/policy/ALGORITHM/", ["train_policy.et_cql"]),
    "evaluate": ("Score policies and model: reports/metrics.json, plots/, video/", ["evaluate"]),
    "report": ("Execute the report notebook: reports/report.ipynb and .html", []),
}
# written out, since to import what knows them takes a second
ROBOT_NAMES = ("hopper", "halfcheetah", "walker2d", "ant")
GLOBAL_OPTIONS = ["task", "seed", "threads", "precision", "compile"]
LIGHTNING = {
    "model": "Lightning's command line of the world model: fit, validate, test (see `envtf model --help`)",
    "agent": "Lightning's command line of the agents: fit, validate (see `envtf agent --help`)",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs `envtf`; exits with 0, with 2 and a sentence for what the user can mend, with 130 when interrupted."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _run(arguments)
    except UserError as error:
        _fail(str(error), 2)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        _fail(f"No space left on the disk ({error}): free some and run the same command again.", 2)
    except KeyboardInterrupt:
        _fail("Interrupted. The same command continues training from the last finished epoch.", 130)


def _run(arguments: list[str]) -> None:
    # Lightning's use of an older torch's name helps nobody
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning)
    if arguments and arguments[0] in LIGHTNING:
        from envtf_lit.cli.lightning import run

        run(arguments[0], arguments[1:])
        return
    parser = build_parser()
    namespace, rest = parser.parse_known_args(arguments)
    if namespace.command not in STAGES and rest:
        parser.error(f"unrecognised arguments: {' '.join(rest)}")
    namespace.run(namespace, rest)


def _fail(sentence: str, status: int) -> None:
    from rich.console import Console

    Console(stderr=True).print(f"envtf: {sentence}", style="red", markup=False, highlight=False, soft_wrap=True)
    raise SystemExit(status)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line, without what Lightning adds."""
    parser = argparse.ArgumentParser(
        "envtf", description="From a log of trajectories to a world model, a policy, and the evidence for both."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_LazyHelp)
    for name, (summary, sections) in STAGES.items():
        command = _add(commands, name, summary, _stage, _lazy_options(sections))
        command.add_argument("--params", default="params.yaml", metavar="FILE", help="default: params.yaml")
        command.add_argument("--quiet", action="store_true", help="no progress bars")
        if name == "train_policy":
            command.add_argument("algorithm", choices=["cql", "et_cql"], help="data alone, or data and imagination")
    for name, summary in LIGHTNING.items():
        commands.add_parser(name, help=summary, add_help=False)
    init = _add(commands, "init", "Write a new project: dvc.yaml, params.yaml, notebooks", _init)
    init.add_argument("folder", type=Path, help="created if missing; what it holds stays as it is")
    params = _add(commands, "params", "Print a complete params.yaml", _params)
    for command in (init, params):
        command.add_argument("--preset", default="small", help="tiny, small, base or paper; default: small")
    _add_data(commands)
    _add_zoo(commands)
    _add_hidden(commands)
    _add_horizon(commands)
    _add_calibrate(commands)
    _add_bench(commands)
    _add(commands, "doctor", "Print versions, threads, GL, disk and GPU for a bug report", _doctor)
    return parser


def _add_data(commands: Any) -> None:
    summary = "Check a dataset, or convert it to another format"
    data = commands.add_parser("data", help=summary, description=f"{summary}.")
    verbs = data.add_subparsers(dest="verb", required=True, metavar="VERB")
    check = _add(verbs, "check", "Print what a dataset holds and every problem in it, each with a fix", _check)
    check.add_argument("source", metavar="IN", help="HDF5 or NPZ file, minari:ID, or a Minari dataset's folder")
    convert = _add(
        verbs, "convert", "Write a dataset in another format, and say what was changed or left behind", _convert
    )
    convert.add_argument("source", metavar="IN", help="the same")
    convert.add_argument("target", metavar="OUT", help="a new file ending in .h5, .hdf5 or .npz, or minari:ID")
    for end in ("low", "high"):
        words = f"{end} limits of the actions, one number or one for each dimension, where the file states none"
        convert.add_argument(f"--action_{end}", type=float, nargs="+", metavar="X", help=words)
    for command in (check, convert):
        command.add_argument("--task", help="robot and tier that the data came from, such as hopper-medium")


def _add_zoo(commands: Any) -> None:
    summary = "Datasets of four robots from behaviour policies that come along: list, build, or train your own"
    zoo = commands.add_parser("zoo", help=summary, description=f"{summary}.")
    verbs = zoo.add_subparsers(dest="verb", required=True, metavar="VERB")
    listing = _add(verbs, "list", "Print the twenty datasets and the policies behind each", _zoo_list)
    build = _add(verbs, "build", "Collect datasets into a folder, with cards, a table and a figure", _zoo_build)
    build.add_argument(
        "tasks",
        nargs="*",
        metavar="TASK",
        help="such as hopper-medium, hopper-medium-v4, ant-medium-105d, hopper-medium-hidden",
    )
    build.add_argument("--all", action="store_true", help="the twenty, beside those named")
    build.add_argument("--out", type=Path, default=Path("data/zoo"), metavar="DIR", help="default: data/zoo")
    size = build.add_mutually_exclusive_group()
    size.add_argument("--transitions", type=int, metavar="N", help="rows of each; default: 200,000")
    size.add_argument("--full", action="store_true", help="1,000,000 rows of each")
    build.add_argument(
        "--workers",
        type=_natural,
        default=os.cpu_count() or 1,
        help="processes; they do not change the data; default: one per core",
    )
    train = _add(verbs, "train", "Train behaviour policies (needs the extra `behaviour`)", _zoo_train)
    train.add_argument("--robot", required=True, choices=ROBOT_NAMES)
    train.add_argument("--out", type=Path, required=True, metavar="DIR", help="for build's and list's --zoo")
    train.add_argument("--algorithm", choices=["crossq", "sac"], default="crossq", help="default: crossq")
    train.add_argument("--steps", type=int, default=600_000, help="environment steps; default: 600,000")
    settle = _add(verbs, "settle", "Exchange a series' last snapshot for the late ones' calmer mean", _zoo_settle)
    settle.add_argument("--robot", required=True, choices=ROBOT_NAMES)
    settle.add_argument("--out", type=Path, required=True, metavar="DIR", help="as given to train")
    settle.add_argument("--last", type=_natural, default=3, metavar="N", help="snapshots to average; default: 3")
    settle.add_argument("--noise", type=float, default=0.5, help="factor of the standard deviations; default: 0.5")
    for command in (build, train):
        command.add_argument("--seed", type=_natural, default=0, help="default: 0")
        command.add_argument("--quiet", action="store_true", help="no progress bars")
    for command in (listing, build):
        command.add_argument("--zoo", type=Path, metavar="DIR", help="policies of your own, from `envtf zoo train`")


def _add_hidden(commands: Any) -> None:
    hidden = _add(
        commands,
        "hidden",
        "Measure what memory is worth where friction, mass and strength are hidden",
        _hidden,
    )
    hidden.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON; the figure lies beside it")
    robots = ["halfcheetah", "walker2d"]
    hidden.add_argument(
        "--robots", nargs="+", default=robots, choices=ROBOT_NAMES, help="default: halfcheetah walker2d"
    )
    hidden.add_argument("--tier", default="medium-replay", help="of the data; default: medium-replay")
    hidden.add_argument("--unseen", type=_natural, default=100_000, metavar="N", help="rows to measure on; 100,000")
    _add_suite(hidden, context=32)


def _add_horizon(commands: Any) -> None:
    horizon = _add(
        commands,
        "horizon",
        "Measure how long world models track reality, beside the ceiling that physics sets",
        _horizon,
    )
    horizon.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="JSON; a table and a folder of figures lie beside it"
    )
    horizon.add_argument("--robots", nargs="+", default=ROBOT_NAMES, choices=ROBOT_NAMES, help="default: all four")
    horizon.add_argument("--tier", default="medium-replay", help="of the data; default: medium-replay")
    horizon.add_argument(
        "--trajectories", type=_natural, default=300, metavar="N", help="fresh episodes with recorded actions; 300"
    )
    horizon.add_argument(
        "--online", type=_natural, default=100, metavar="N", help="fresh episodes of each online policy; 100"
    )
    horizon.add_argument(
        "--start", type=_natural, default=0, metavar="N", help="steps of each episode to leave out; default: 0"
    )
    _add_models(horizon)
    _add_suite(horizon, context=16)


def _add_calibrate(commands: Any) -> None:
    summary = "Measure what world models know of their own errors: coverage, detection of new data, errors of rollouts"
    calibrate = _add(commands, "calibrate", summary, _calibrate)
    calibrate.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="JSON; a table and a figure lie beside it"
    )
    calibrate.add_argument("--robots", nargs="+", default=ROBOT_NAMES, choices=ROBOT_NAMES, help="default: all four")
    calibrate.add_argument("--tier", default="medium", help="of the data; default: medium")
    _add_models(calibrate)
    _add_suite(calibrate, context=16)


def _add_models(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--model",
        action="append",
        default=[],
        metavar="NAME=FOLDER",
        help="a further world model; {task} and {robot} in the folder stand for their names; may be repeated",
    )


def _add_bench(commands: Any) -> None:
    summary = "Measure the world model's speed and what its accuracy costs, beside what it would replace"
    bench = commands.add_parser("bench", help=summary, description=f"{summary}.")
    verbs = bench.add_subparsers(dest="verb", required=True, metavar="VERB")
    speed = _add(
        verbs, "model", "Imagination and training, against ensemble, simulator and matrix product", _bench_model
    )
    speed.add_argument("--preset", default="small", help="tiny, small, base or paper; default: small")
    speed.add_argument("--device", metavar="NAME", help="such as cpu; default: the accelerator if there is one")
    speed.add_argument("--precision", choices=["fp32", "bf16"], default="bf16", help="of both sides; default: bf16")
    speed.add_argument("--compile", action="store_true", help="run all models through torch.compile")
    speed.add_argument("--windows", type=_positive, metavar="N", help="of a gradient step; default: the preset's")
    speed.add_argument("--batch", type=_positive, default=4_096, metavar="N", help="rollouts at a time; default: 4096")
    speed.add_argument("--horizon", type=_positive, default=5, metavar="N", help="steps of each; default: 5")
    speed.add_argument("--rounds", type=_positive, default=5, metavar="N", help="medians are reported; default: 5")
    speed.add_argument("--seed", type=_natural, default=0, help="default: 0")
    speed.add_argument("--threads", type=_positive, default=os.cpu_count() or 1, help="default: one per core")
    cost = _add(verbs, "cost", "Training to equal held-out error: transformer, ensemble, plain network", _bench_cost)
    cost.add_argument("--task", default="hopper-medium-replay", help="default: hopper-medium-replay")
    _add_suite(cost, context=16)
    for command in (speed, cost):
        command.add_argument("--out", type=Path, metavar="FILE", help="JSON")


def _add_suite(command: argparse.ArgumentParser, *, context: int) -> None:
    """The options of a command that trains the suite of world models, unless they lie in its folder."""
    command.add_argument("--work", type=Path, default=Path(".envtf/suite"), metavar="DIR", help="default: .envtf/suite")
    command.add_argument("--transitions", type=_natural, default=100_000, metavar="N", help="rows of data; 100,000")
    command.add_argument("--updates", type=_natural, default=6_000, metavar="N", help="of the transformers; 6,000")
    command.add_argument(
        "--windows", type=_positive, default=32, metavar="N", help="of --context steps per update of theirs; 32"
    )
    command.add_argument(
        "--ensemble-updates", type=_positive, default=100_000, metavar="N", help="of the ensemble at most; 100,000"
    )
    command.add_argument("--context", type=_natural, default=context, metavar="N", help=f"steps; default: {context}")
    command.add_argument("--seed", type=_natural, default=0, help="default: 0")
    command.add_argument("--threads", type=_natural, default=os.cpu_count() or 1, help="default: one per core")
    command.add_argument("--compile", action="store_true", help="run them through torch.compile: pays on a GPU")
    command.add_argument("--quiet", action="store_true", help="no progress bars")


class _LazyHelp(argparse.ArgumentParser):
    """Writes its list of options only when help is asked for: reading them all costs more than most commands."""

    options: Callable[[], str] = staticmethod(lambda: "")

    def format_help(self) -> str:
        return super().format_help() + self.options()


def _add(
    commands: Any,
    name: str,
    summary: str,
    run: Callable[[argparse.Namespace, list[str]], None],
    options: Callable[[], str] = lambda: "",
) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=summary, description=f"{summary}.", allow_abbrev=False)
    command.set_defaults(run=run)
    command.options = options
    return command


def _lazy_options(sections: list[str]) -> Callable[[], str]:
    """The part of a stage's help that explains the options in params.yaml."""

    def text() -> str:
        from envtf_lit.pipeline.yaml import describe

        lines = ["", "options of params.yaml, each also a flag, such as --seed 1 or --train_model.updates=500:"]
        for option in (option for section in [*GLOBAL_OPTIONS, *sections] for option in describe(section)):
            default = "null" if option.default is None else option.default
            lines.append(f"  --{option.key}  ({option.kind}, default {default})")
            lines.append(fill(option.meaning, 110, initial_indent=" " * 8, subsequent_indent=" " * 8))
        return "\n".join(lines) + "\n"

    return text


def _stage(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.pipeline.yaml import load_params

    params = load_params(namespace.params, flags_to_overrides(rest))

    _hush_lightning()
    os.environ.pop("MUJOCO_GL", None)  # a back end that is missing breaks `import mujoco`; videos probe for their own
    extra = {"algorithm": namespace.algorithm} if namespace.command == "train_policy" else {}
    stage = getattr(import_module(f"envtf_lit.pipeline.{namespace.command}"), namespace.command)
    metrics = stage(params, **extra, progress=not namespace.quiet)
    Console().print_json(data=metrics)


def _hush_lightning() -> None:
    """A stage shows progress and a result; Lightning's hints help nobody."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)


def flags_to_overrides(flags: Sequence[str]) -> list[str]:
    """`--a.b 1` and `--a.b=1` as `a.b=1`.

    Raises:
        UserError: something that is not a flag with a value.
    """
    overrides, waiting = [], None
    for flag in flags:
        if waiting is not None:
            overrides.append(f"{waiting}={flag}")
            waiting = None
        elif not flag.startswith("--"):
            raise UserError(f"{flag!r} is not an option: write --section.key value, such as --train_model.updates 500.")
        elif "=" in flag:
            overrides.append(flag[2:])
        else:
            waiting = flag[2:]
    if waiting is not None:
        raise UserError(f"--{waiting} needs a value.")
    return overrides


def _init(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.project.template import write_project

    kept, console = write_project(namespace.folder, namespace.preset), Console(highlight=False, soft_wrap=True)
    if kept:
        console.print(f"Left as they were: {', '.join(kept)}", markup=False)
    first = "" if find_spec("dvc") else "pip install 'envtf-lit[pipeline]' && "
    following = f"Next: {first}cd {namespace.folder} && dvc repro"
    console.print(f"Wrote a project to {namespace.folder}. {following}", markup=False)


def _params(namespace: argparse.Namespace, rest: list[str]) -> None:
    from envtf_lit.pipeline.yaml import params_yaml, preset_params

    sys.stdout.write(params_yaml(preset_params(namespace.preset)))


def _doctor(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.project.doctor import report

    for name, value in report().items():
        Console().print(f"{name:<16} {value}", markup=False, highlight=False, soft_wrap=True)


def _check(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.data.inspection import inspect_source, render

    inspection = inspect_source(namespace.source, task=namespace.task)
    Console().print(render(inspection), soft_wrap=True)
    if not inspection.usable:
        raise SystemExit(2)


def _convert(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.data.conversion import convert

    limits = {name: getattr(namespace, name) for name in ("action_low", "action_high")}
    dataset, findings = convert(namespace.source, namespace.target, task=namespace.task, **limits)
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"Wrote {len(dataset):,} transitions to {namespace.target}", markup=False)
    for finding in findings:
        console.print(f"{finding.kind}: {finding}", markup=False)


def _zoo_list(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    from envtf_lit.zoo.build import catalogue

    table = Table("dataset", "policies", "score of their deterministic actions", box=None)
    for line in catalogue(namespace.zoo):
        table.add_row(*line)
    Console().print(table)


def _comparison(namespace: argparse.Namespace) -> dict[str, Any]:
    """What every comparison of the suite's models is asked for."""
    from rich.console import Console

    _hush_lightning()
    return dict(
        out=namespace.out,
        robots=namespace.robots,
        tier=namespace.tier,
        work=namespace.work,
        options=_suite_options(namespace),
        progress=not namespace.quiet,
        report=Console(highlight=False, markup=False, soft_wrap=True).print,
    )


def _hidden(namespace: argparse.Namespace, rest: list[str]) -> None:
    from envtf_lit.studies.memory import HiddenOptions, compare

    compare(**_comparison(namespace), measured=HiddenOptions(namespace.unseen))


def _horizon(namespace: argparse.Namespace, rest: list[str]) -> None:
    from envtf_lit.studies.horizon import HorizonOptions, compare

    compare(
        **_comparison(namespace),
        measured=HorizonOptions(namespace.trajectories, namespace.online, namespace.start),
        others=_named_folders(namespace),
    )


def _calibrate(namespace: argparse.Namespace, rest: list[str]) -> None:
    from envtf_lit.studies.calibration import compare

    compare(**_comparison(namespace), others=_named_folders(namespace))


def _named_folders(namespace: argparse.Namespace) -> dict[str, str]:
    """What the options `--model` say."""
    found = dict[str, str]()
    for text in namespace.model:
        name, _, folder = text.partition("=")
        if not (name and folder):
            raise UserError(f"--model {text!r} has no name and folder: write --model NAME=FOLDER.")
        found[name] = folder
    return found


def _bench_model(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.studies.speed import bench_model

    names = ("preset", "device", "precision", "compile", "threads", "windows", "batch", "horizon", "rounds", "seed")
    Console().print_json(data=bench_model(namespace.out, **{name: getattr(namespace, name) for name in names}))


def _bench_cost(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.studies.cost import bench_cost

    _hush_lightning()
    options, progress = _suite_options(namespace), not namespace.quiet
    result = bench_cost(namespace.out, task=namespace.task, work=namespace.work, options=options, progress=progress)
    Console().print_json(data=result)


def _suite_options(namespace: argparse.Namespace) -> Any:
    from envtf_lit.studies.suite import SuiteOptions
    from envtf_lit.world_models.options import EnsembleOptions

    names = ("transitions", "updates", "windows", "context", "seed", "threads", "compile")
    most = namespace.ensemble_updates
    ensemble = EnsembleOptions(updates=most, updates_per_epoch=min(EnsembleOptions().updates_per_epoch, most))
    return SuiteOptions(ensemble=ensemble, **{name: getattr(namespace, name) for name in names})


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is below zero: choose 0 or more")
    return value


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is too few: choose 1 or more")
    return value


def _zoo_build(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.figures.zoo import score_distributions
    from envtf_lit.robots.tasks import TASKS
    from envtf_lit.zoo.build import FULL, TRANSITIONS, build

    console = Console(highlight=False, markup=False, soft_wrap=True)
    build(
        [*(TASKS if namespace.all else ()), *namespace.tasks],
        namespace.out,
        transitions=FULL if namespace.full else TRANSITIONS if namespace.transitions is None else namespace.transitions,
        seed=namespace.seed,
        workers=namespace.workers,
        zoo=namespace.zoo,
        progress=not namespace.quiet,
        draw=score_distributions,
        report=console.print,
    )
    console.print(f"Table and figure: {namespace.out}/index.md")


def _zoo_train(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.robots.tasks import ROBOTS
    from envtf_lit.zoo.train import train

    folder = train(
        ROBOTS[namespace.robot],
        namespace.out,
        algorithm=namespace.algorithm,
        steps=namespace.steps,
        seed=namespace.seed,
        progress=not namespace.quiet,
    )
    Console().print(f"Wrote {folder}. Next: envtf zoo build --zoo {namespace.out} TASK", soft_wrap=True)


def _zoo_settle(namespace: argparse.Namespace, rest: list[str]) -> None:
    from rich.console import Console

    from envtf_lit.robots.tasks import ROBOTS
    from envtf_lit.zoo.train import average_last_snapshots

    robot = ROBOTS[namespace.robot]
    kept = average_last_snapshots(robot, namespace.out, last=namespace.last, noise=namespace.noise)
    score = robot.normalised_score(kept.mean_return)
    Console().print(f"The last snapshot now returns {kept.mean_return:.0f} (score {score:.1f}).", soft_wrap=True)
