"""A suite: the three world models that studies compare, trained on one of the zoo's datasets, and kept on disk.

The transformer, the same transformer with a context of one step, and the ensemble. A model that lies there already,
trained with the same settings, is not trained again.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning as L
import torch

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources.fetch import sha256
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.devices import pick_device, resolved
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import read_json, write_json
from envtf_lit.options.schema import Precision, build, rebuild
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import CARD, DATASET, run_settings
from envtf_lit.results import has, read_or_none, refuse_others
from envtf_lit.robots.tasks import Robot, Task, get_task
from envtf_lit.studies.machine import hardware
from envtf_lit.training import run_folder
from envtf_lit.world_models.fit import fit_world_model
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions, WorldModelOptions
from envtf_lit.world_models.store import load_world_model
from envtf_lit.zoo.snapshots import describe_origin

MODELS = ("transformer", "context_1", "ensemble")  # their names in every table, figure and file
PHYSICS = "physics"  # what stands beside them under that name, so that no other model may have it
WORDS = ("trained_with", "note")  # of a dataset's origin: about the whole series, of which a tier may use a part
SHARED = ("seed", "threads", "precision", "compile")  # options that a suite has in common with `Params`
FORMAT = 4  # of saved transformers; those of before cannot be read and are trained anew
WORK = Path(".envtf/suite")  # where suites are kept unless told otherwise


@dataclass(frozen=True)
class SuiteOptions:
    """The dataset of a suite, the sizes of its models, and their budgets.

    Attributes:
        transitions: rows of the zoo's dataset.
        updates: gradient steps of the transformer and of its ablation, which sees as many steps per update.
        windows: of `context` steps per update of the transformer.
        context: of the transformer, steps.
        ensemble: the ensemble and its budget; it stops early.
        seed: of data and training.
        threads: CPU threads.
        precision: of matrix products in training.
        compile: as in `Params`; the models are measured through torch.compile, too.
    """

    transitions: int = 100_000
    updates: int = 6_000
    windows: int = TransformerOptions().batch_size
    context: int = TransformerOptions().context
    ensemble: EnsembleOptions = field(default_factory=EnsembleOptions)
    seed: int = 0
    threads: int = 2
    precision: Precision = "auto"
    compile: bool = False


@dataclass(frozen=True)
class Suite:
    """A dataset and the world models trained on it, on disk; `load_world_model(suite.folders[name])` gives one.

    Attributes:
        task: robot and tier.
        robot: its robot.
        options: what it was made with.
        dataset: the file that all models were trained on.
        folders: by the model's name.
        seconds: of training, by the model's name, as measured when it was trained.
        updates: gradient steps that it was trained for, by the model's name; the ensemble stops early.
    """

    task: str
    robot: Robot
    options: SuiteOptions
    dataset: Path
    folders: dict[str, Path]
    seconds: dict[str, float]
    updates: dict[str, int]

    @property
    def home(self) -> Path:
        """The folder of all that belongs to the task: data, models, results of studies."""
        return self.dataset.parents[1]

    @property
    def costs(self) -> dict[str, float]:
        """`robot.model.train_seconds` and `robot.model.updates` of every model."""
        kinds = {"train_seconds": self.seconds, "updates": self.updates}
        return {f"{self.robot.name}.{name}.{kind}": value for kind, by in kinds.items() for name, value in by.items()}

    def split(self) -> tuple[OfflineDataset, OfflineDataset | None, OfflineDataset]:
        """The episodes for training, for calibration (None if there are too few), and for testing, of every model."""
        training, held_out = load_dataset(self.dataset).split()
        calibrating, testing = held_out.validation_and_test()
        return training, calibrating if len(held_out.episode_starts) > 1 else None, testing


def flat_settings(tier: str, options: SuiteOptions, **measured: Any) -> dict[str, Any]:
    """The settings of a study, under flat keys: `tier`, `suite.…`, `versions.…`, and the study's own options.

    Args:
        tier: of the data.
        options: of the data and the models.
        measured: dataclasses that say what is measured, under the name that goes before their keys.
    """
    kept = ("transitions", "updates", "windows", "context", *SHARED)
    return {
        "tier": tier,
        **{f"suite.{name}": getattr(options, name) for name in kept},
        "suite.precision": resolved(options.precision),
        **{f"{prefix}.{name}": value for prefix, what in measured.items() for name, value in asdict(what).items()},
        **{f"versions.{name}": version(name) for name in ("gymnasium", "mujoco", "numpy", "torch")},
    }


def result_header(tier: str, options: SuiteOptions, **measured: Any) -> dict[str, Any]:
    """The first keys of a study's JSON file: `flat_settings`, `suite.ensemble.…` and `machine.…`.

    `cached_result` asks for neither of the latter: the models' bytes tell how they were trained, and the machine hardly
    counts.
    """
    ensemble = {f"suite.ensemble.{name}": value for name, value in _plain(asdict(options.ensemble)).items()}
    machine = {f"machine.{name}": value for name, value in hardware(pick_device()).items()}
    return flat_settings(tier, options, **measured) | ensemble | machine


def cached_result(
    home: Path, name: str, settings: dict[str, Any], inputs: Sequence[Path], measure: Callable[[], Any]
) -> Any:
    """The result of a measurement, as JSON has it: read if it was made with these settings on the same inputs.

    Args:
        home: folder below which results are kept.
        name: of the measurement.
        settings: as `flat_settings` has them.
        inputs: files and folders whose bytes count.
        measure: called where there is no such result yet.
    """
    place = run_folder(home, name, settings, inputs).with_suffix(".json")
    if not place.exists():
        write_json(place, measure())
    return read_json(place)


def load_for_study(folder: Path, options: SuiteOptions) -> WorldModel:
    """The world model in a folder, on the accelerator if there is one, through torch.compile if the suite is."""
    return load_world_model(folder, fused=options.compile).to(pick_device())


def other_folders(others: Mapping[str, str], tasks: Sequence[Task]) -> dict[str, dict[str, Path]]:
    """Folders of models beside the suite's, by task and name; each is read once, so that none fails hours later.

    Args:
        others: name to folder; `{task}` and `{robot}` in a folder stand for those names.
        tasks: that the models are compared on.

    Raises:
        UserError: a name that is taken or holds a dot, or a folder without a world model of the robot.
    """
    for name in others:
        if name in (*MODELS, PHYSICS) or "." in name:
            raise UserError(f"A model cannot be called {name!r} here: choose a name of your own, without dots.")
    return {task.name: {name: _folder_of(folder, task) for name, folder in others.items()} for task in tasks}


def _folder_of(pattern: str, task: Task) -> Path:
    """The task's folder, which holds a model of its robot."""
    folder, robot = Path(pattern.replace("{task}", task.name).replace("{robot}", task.robot.name)), task.robot
    model = load_world_model(folder)
    if (model.observation_dim, model.action_dim) != (robot.observation_dim, robot.action_dim):
        raise UserError(f"{folder} holds a world model of another robot: give one of {robot.name}.")
    return folder


def build_suite(
    task: str, root: Path, options: SuiteOptions, *, models: Sequence[str] = MODELS, progress: bool = True
) -> Suite:
    """Collects the task's dataset and trains the models, all below `root / task`; what is there is kept.

    Args:
        task: robot and tier, such as `hopper-medium`.
        root: folder of suites.
        options: of the data and the models.
        models: which of `MODELS`.
        progress: shows bars.

    Raises:
        UserError: an unknown task or model, or options that are out of range or contradict each other.
    """
    for name in models:
        if name not in MODELS:
            raise UserError(f"Unknown model {name!r}: {did_you_mean(name, MODELS)}")
    home, trained = root / task, {name: model_options(name, options) for name in models}
    key = {"task": task, "transitions": options.transitions, "seed": options.seed}
    origin = _plain(describe_origin(get_task(task), options.transitions, options.seed))
    key |= {"origin": {name: value for name, value in origin.items() if name not in WORDS}}
    shared, card = _checked(replace(Params(), task=task, **_common(options))), home / CARD
    # a record that is older than this key is judged by the dataset's card
    older = {"origin": {name: read_json(card).get(name) for name in key["origin"]}} if card.exists() else {}
    suite = Suite(task, get_task(task).robot, options, home / DATASET, {}, {}, {})
    work = partial(download, shared, home, progress=progress)
    _unless_done(home / "data.json", suite.dataset, key, work, older)
    for name in models:
        add_model(suite, name, trained[name], progress=progress)
    return suite


def add_model(suite: Suite, name: str, options: WorldModelOptions, *, progress: bool = True) -> None:
    """Trains a model on a suite's dataset and enters it there; one that lies there, trained alike, is kept.

    Args:
        suite: gives data, seed, threads and precision.
        name: of the model, and of its folder.
        options: of the model and its training.
        progress: shows a bar.

    """
    home, shared = suite.home, suite.options
    params = replace(Params(), task=suite.task, **_common(shared))
    key = {"task": suite.task, "transitions": shared.transitions, **{name: getattr(shared, name) for name in SHARED}}
    key |= {"train_model": _plain(asdict(options)), "dataset": sha256(suite.dataset)}
    key |= {"format": FORMAT} if isinstance(options, TransformerOptions) else {}
    suite.folders[name] = home / "models" / name
    train = partial(_train, params, options, suite.dataset, suite.folders[name], home, progress)
    record = home / "models" / f"{name}.json"
    # an option that is younger than the record had its default when that was written
    older: dict[str, Any] = {"train_model": _plain(asdict(type(options)())), "compile": False}
    if record.exists() and record.stat().st_mtime >= suite.dataset.stat().st_mtime:  # trained on what lies there
        older["dataset"] = key["dataset"]
    suite.seconds[name] = _unless_done(record, suite.folders[name], key, train, older)
    epochs = len((suite.folders[name] / "curves.csv").read_text().splitlines()) - 1  # the first line names columns
    suite.updates[name] = epochs * options.updates_per_epoch


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    """As JSON has them, with lists for tuples."""
    return json.loads(json.dumps(options))


def _common(options: SuiteOptions) -> dict[str, Any]:
    """The pipeline's parameters that a suite sets: `SHARED`, and the size of the dataset."""
    download = DownloadOptions(transitions=options.transitions)
    return {name: getattr(options, name) for name in SHARED} | {"download": download}


def _checked(params: Params) -> Params:
    """The same, types and ranges checked.

    Raises:
        UserError: an option is of the wrong type or out of range.
    """
    build(Params, {name: getattr(params, name) for name in SHARED}, "")
    rebuild(params.download)
    return params


def model_options(name: str, options: SuiteOptions) -> WorldModelOptions:
    """The options that train one of `MODELS`.

    Raises:
        UserError: options that are out of range or contradict each other.
    """
    if name == "ensemble":  # one for every budget of the transformer's
        return rebuild(options.ensemble)
    train = TransformerOptions(
        updates=options.updates,
        updates_per_epoch=max(1, min(1_000, options.updates)),
        batch_size=options.windows,
        context=options.context,
    )
    if name == "context_1":  # windows of one step, as many steps per update
        train = replace(train, context=1, batch_size=train.batch_size * options.context)
    return rebuild(train)


def _unless_done(
    record: Path, product: Path, settings: dict[str, Any], work: Callable[[], object], older: dict[str, Any]
) -> float:
    """Seconds that the work took, now or when it was done with the same settings; `older` completes old records."""
    done = read_or_none(record)
    if not has(done, "settings", "seconds"):
        refuse_others((record, product), "none of what was kept here; move it, or choose another --work")
    elif _over(older, done["settings"]) == settings:
        return done["seconds"]
    write_json(record, {"settings": None, "seconds": None})  # what lies there is about to be replaced
    begin = time.perf_counter()
    work()
    seconds = time.perf_counter() - begin
    write_json(record, {"settings": settings, "seconds": round(seconds, 3)})
    return round(seconds, 3)


def _over(defaults: Any, given: Any) -> Any:
    """What is given, completed by defaults, section by section."""
    if not (isinstance(defaults, dict) and isinstance(given, dict)):
        return given
    return defaults | {name: _over(defaults.get(name), value) for name, value in given.items()}


def _train(params: Params, options: WorldModelOptions, dataset: Path, folder: Path, home: Path, progress: bool) -> None:
    torch.set_num_threads(params.threads)
    L.seed_everything(params.seed, verbose=False)
    fit_world_model(
        options,
        dataset,
        folder,
        seed=params.seed,
        precision=params.precision,
        compile=params.compile,
        settings=run_settings(params, options),
        root=home,
        progress=progress,
    )
