"""`envtf model …` and `envtf agent …`: LightningCLI over the classes that the pipeline trains."""

import itertools
import json
import os
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from jsonargparse import Namespace
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.plugins.io import TorchCheckpointIO
from rich.console import Console

from envtf_lit.agents.cql import CQL
from envtf_lit.agents.options import PolicyOptions, check_no_imagination, check_policy
from envtf_lit.agents.store import publish_policy
from envtf_lit.cli.saved_options import checkpoint_options, model_architecture, policy_architecture
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import TransitionData, WindowData
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.data.sources.minari import read_minari
from envtf_lit.errors import UserError
from envtf_lit.files import replacing
from envtf_lit.options.schema import build_section
from envtf_lit.pipeline.params import Params
from envtf_lit.training import Curves, WholeCheckpoints
from envtf_lit.world_models.fit import publish_world_model
from envtf_lit.world_models.lit import LitEnsemble, LitWorldModel, lit_world_model, window_options
from envtf_lit.world_models.options import TrainModelOptions, check_world_model

CONFIGS = Path(__file__).parent.parent / "configs"
SHIPPED = ", ".join(sorted(path.stem for path in CONFIGS.glob("*.yaml")))

TRUST = (
    "A --config file is trusted like code: it may name any class to run, so take one only from where you would take a "
    "program. Weights (--model.init_from) and checkpoints (--ckpt_path) are read as data alone. A run continued with "
    "--ckpt_path keeps the checkpoint's options where no flag says otherwise: to train on for longer, add "
    "--model.options.updates N, or --trainer.max_epochs N to leave the learning-rate schedule as it is. A model that "
    "starts from another (--model.init_from) has its architecture where no flag says otherwise. After fit, the weights "
    "of the last update, or of the best epoch where a ModelCheckpoint with a monitor says which that is, lie in the "
    "folder `published`, or `published_1`, …, beside an earlier run's; its path is printed. --config takes a file, or "
    "the name of one that comes along: "
    f"{SHIPPED}."
)

SECTION = "model.options"  # of the command line, which errors name
LIGHTNINGS_OWN = re.compile(r"(best|last|hpc|registry.*|\w+://.*)$")  # checkpoints that are not local paths


def world_model(
    observation_dim: int,
    action_dim: int,
    options: TrainModelOptions = TrainModelOptions(),  # noqa: B008 (frozen)
    seed: int = 0,
    init_from: str | None = None,
    freeze: list[str] = [],  # noqa: B006 (read alone)
    compile: bool = False,
) -> LitWorldModel:
    """Environment Transformer, or the usual ensemble, trained on windows of a log.

    Args:
        observation_dim: S, taken from the data.
        action_dim: A, taken from the data.
        options: as train_model in params.yaml.
        seed: of dropout and of sampled objectives.
        init_from: a published model folder (as models/world_model) whose weights to start from. Scales are those of the
            new data; projections to and from another robot's dimensions begin anew.
        freeze: parts of the model that stay as they are: embed, blocks, blocks.0, norm, head, …
        compile: fuses the operations of the training loss by torch.compile, which pays on a GPU.
    """
    return lit_world_model(observation_dim, action_dim, options, seed, init_from, freeze, compile)


def agent(
    observation_dim: int,
    action_dim: int,
    options: PolicyOptions = PolicyOptions(),  # noqa: B008 (frozen)
    action_low: list[float] | None = None,
    action_high: list[float] | None = None,
    seed: int = 0,
    init_from: str | None = None,
    freeze: list[str] = [],  # noqa: B006 (read alone)
) -> CQL:
    """Conservative Q-Learning on a log alone.

    Args:
        observation_dim: S, taken from the data.
        action_dim: A, taken from the data.
        options: as train_policy.cql in params.yaml.
        action_low: (A,), taken from the data.
        action_high: (A,), taken from the data.
        seed: of everything random.
        init_from: a published policy folder (as models/policy/cql) whose actor to start from, with the scales of the
            new data; layers for another robot's dimensions begin anew. Such folders hold no critics, so these start
            anew, and the warm start fits them alone.
        freeze: parts of the actor that stay as they are: net.0, net.2, …
    """
    return CQL(observation_dim, action_dim, options, action_low, action_high, seed, init_from, freeze)


class _Sourced:
    """Reads a dataset from where `source` says."""

    source: Literal["file", "minari"]

    def read(self, path: str) -> OfflineDataset:
        """A file, or a Minari dataset of this machine; the network is for `envtf download` alone."""
        return load_dataset(path) if self.source == "file" else read_minari(path)


class LogWindows(_Sourced, WindowData):
    """Windows of a log, for world models.

    Args:
        path: dataset file, HDF5 or NPZ, or a Minari dataset's id or folder.
        source: which of the two: `file` or `minari`.
        options: see `WindowData`.
    """

    def __init__(self, path: str, source: Literal["file", "minari"] = "file", **options: Any) -> None:
        self.source = source
        super().__init__(path, **options)


class LogTransitions(_Sourced, TransitionData):
    """Transitions of a log, for agents.

    Args:
        path: dataset file, HDF5 or NPZ, or a Minari dataset's id or folder.
        source: which of the two: `file` or `minari`.
        options: see `TransitionData`.
    """

    def __init__(self, path: str, source: Literal["file", "minari"] = "file", **options: Any) -> None:
        self.source = source
        super().__init__(path, **options)


class Publish(Callback):
    """Writes what was trained as a model folder, as the pipeline's stages do, beside the run's logs.

    What an earlier run published there stays, and a trial run, `fast_dev_run`, leaves nothing behind.
    """

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        # by all processes: each may hold a part of the weights
        state, place = trainer.strategy.lightning_module_state_dict(), _folder(trainer) / "published"
        if trainer.fast_dev_run or not trainer.is_global_zero:  # pyright: ignore[reportAttributeAccessIssue]
            return
        folder = _free(place)
        curves = _curves(trainer)
        weights, row = "last update", curves.rows[-1] if curves.rows else {}
        if isinstance(pl_module, LitEnsemble):
            weights = "members at their best"
        if (checkpoint := _best(trainer)) is not None:
            saved = torch.load(checkpoint.best_model_path, map_location="cpu", weights_only=True)
            state, row = saved["state_dict"], next((r for r in curves.rows if r["epoch"] == saved["epoch"] + 1), {})
            weights = f"epoch of best {checkpoint.monitor}, {checkpoint.best_model_score:.4g}"
        module = type(pl_module)(**pl_module.hparams).to(pl_module.device)  # whole, however the other one is spread
        module.load_state_dict(state)
        settings = dict(pl_module.hparams)
        if isinstance(module, LitWorldModel):
            data: WindowData = trainer.datamodule  # pyright: ignore[reportAttributeAccessIssue]
            publish_world_model(folder, module, data, curves, row, settings)
        elif isinstance(module, CQL):
            publish_policy(folder, module.average_actor, curves, row, settings)
        Console().print(f"Published the weights of the {weights}: {folder}", highlight=False, soft_wrap=True)


def _curves(trainer: L.Trainer) -> Curves:
    """What was logged, as `instantiate_trainer` has it noted."""
    callbacks: list[Callback] = trainer.callbacks  # pyright: ignore[reportAttributeAccessIssue]
    return next(callback for callback in callbacks if isinstance(callback, Curves))


def _best(trainer: L.Trainer) -> ModelCheckpoint | None:
    """The callback that kept the weights of the best epoch, where one was asked to."""
    kept = (c for c in trainer.checkpoint_callbacks if isinstance(c, ModelCheckpoint) and c.monitor is not None)
    return next((c for c in kept if c.best_model_path), None)


class KeepConfig(SaveConfigCallback):
    """Writes the whole configuration to `config.yaml`, or `config_1.yaml`, …, beside the run's logs."""

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self.folder = _folder(trainer)
        super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        with replacing(_free(self.folder / "config.yaml")) as temporary:
            self.parser.save(self.config, str(temporary), skip_none=False, multifile=False)


def _folder(trainer: L.Trainer) -> Path:
    """The run's own folder; not every logger has one. To be asked by all processes: the first tells the others."""
    return Path(trainer.log_dir or trainer.default_root_dir)


def _free(path: Path) -> Path:
    """The path, or the first of `NAME_1`, `NAME_2`, … that is not there: without a logger, runs share a folder."""
    numbered = (path.with_stem(f"{path.stem}_{number}") for number in itertools.count(1))
    return next(free for free in itertools.chain([path], numbered) if not os.path.lexists(free))


class _LinkedCLI(LightningCLI):
    """Takes dimensions from the dataset, asks only once for what model and data share, and stops when updates say."""

    from_data: tuple[str, ...] = ("observation_dim", "action_dim")
    links: dict[str, str]
    options: type[TrainModelOptions] | type[PolicyOptions]
    architecture: Callable[[str], dict[str, Any]]  # the options that a published folder's weights ask for
    verbs: tuple[str, ...]

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name in self.from_data:
            parser.link_arguments(f"data.{name}", f"model.{name}", apply_on="instantiate")
        for source, target in self.links.items():
            parser.link_arguments(source, target)
        self.link_more(parser)

    def link_more(self, parser: LightningArgumentParser) -> None:
        """Links that take a computation."""

    def subcommands(self) -> dict[str, set[str]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        verbs = LightningCLI.subcommands()
        return {verb: verbs[verb] | {"weights_only"} for verb in self.verbs}

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        return {**super()._prepare_subcommand_kwargs(subcommand), "weights_only": True}  # checkpoints are data

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        with warnings.catch_warnings():  # these are this command's arguments, whatever stands in sys.argv
            warnings.filterwarnings("ignore", "LightningCLI's args parameter")
            super().parse_arguments(parser, args)
            verb = self.config.subcommand
            checkpoint, base = self.config[verb].ckpt_path, self.config[verb].model.init_from
            if checkpoint is not None and not LIGHTNINGS_OWN.match(checkpoint):
                below = checkpoint_options(checkpoint, self.options)
            elif base is not None:
                below = {"options": self.architecture(base)}
            else:
                return
            begin = args.index(verb) + 1  # below flags: the first --config
            super().parse_arguments(parser, [*args[:begin], "--config", json.dumps({"model": below}), *args[begin:]])

    def instantiate_trainer(self, **kwargs: Any) -> L.Trainer:
        trainer = super().instantiate_trainer(**kwargs)
        # only now: Lightning would take it for the callback that saves checkpoints, and make none;
        # at the front, so that checkpoints hold the row of their epoch
        trainer.callbacks.insert(0, Curves())  # pyright: ignore[reportAttributeAccessIssue]
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:  # neither a strategy's own nor the user's
            trainer.strategy.checkpoint_io = WholeCheckpoints()
        return trainer

    @staticmethod
    def check(options: Any) -> None:
        """The rules that tie these options together, as for params.yaml.

        Raises:
            UserError: one is broken.
        """
        raise NotImplementedError

    def _parse_ckpt_path(self) -> None:
        """Lightning would let the checkpoint's options win over flags; see `parse_arguments`."""

    def before_instantiate_classes(self) -> None:
        config = self.config[str(self.subcommand)]
        options, trainer = config.model.options, config.trainer
        self.check(build_section(self.options, _plain(options), SECTION))
        build_section(Params, {"seed": config.model.seed}, "model")
        budget = _unwrapped(options).get("ensemble") or options
        if trainer.max_epochs is None and trainer.max_steps == -1:
            trainer.max_epochs = budget.updates // budget.updates_per_epoch
        if trainer.gradient_clip_val is None:  # refused under the agents' manual optimisation, and they have none
            trainer.gradient_clip_val = budget.get("gradient_clip")


class ModelCLI(_LinkedCLI):
    """`envtf model`."""

    options = TrainModelOptions
    architecture = staticmethod(model_architecture)
    verbs = ("fit", "validate", "test")
    links = {"model.options.held_out": "data.held_out", "model.seed": "data.seed"}

    @staticmethod
    def check(options: TrainModelOptions) -> None:
        check_world_model(options, SECTION)

    def link_more(self, parser: LightningArgumentParser) -> None:
        for name in ("context", "batch_size", "updates_per_epoch", "members"):
            parser.link_arguments("model.options", f"data.{name}", compute_fn=_window_option(name))


class AgentCLI(_LinkedCLI):
    """`envtf agent`."""

    options = PolicyOptions
    architecture = staticmethod(policy_architecture)
    verbs = ("fit", "validate")
    from_data = ("observation_dim", "action_dim", "action_low", "action_high")
    links = {
        "model.options.batch_size": "data.batch_size",
        "model.options.updates_per_step": "data.updates_per_step",
        "model.options.discount": "data.discount",
        "model.options.n_step": "data.n_step",
        "model.options.return_temperature": "data.return_temperature",
        "model.seed": "data.seed",
    }

    @staticmethod
    def check(options: PolicyOptions) -> None:
        check_no_imagination(options, SECTION)
        check_policy(options, SECTION)

    def link_more(self, parser: LightningArgumentParser) -> None:
        updates = ("model.options.updates_per_epoch", "model.options.updates_per_step")
        parser.link_arguments(updates, "data.steps_per_epoch", compute_fn=lambda epoch, step: epoch // (step or 1))


def _window_option(name: str) -> Callable[[Namespace], Any]:
    return lambda options: window_options(_unwrapped(options))[name]


def _unwrapped(options: Namespace) -> Any:
    """The ensemble's options as plain attributes: while jsonargparse links, it wraps an optional dataclass."""
    ensemble = options.get("ensemble") or Namespace()
    return Namespace({**vars(options), "ensemble": ensemble.get("init_args", ensemble) or None})


def _plain(options: Namespace) -> dict[str, Any]:
    """The options as nested dictionaries, whatever jsonargparse wraps around optional dataclasses."""
    values = {name: _plain(value) if isinstance(value, Namespace) else value for name, value in vars(options).items()}
    return values.get("init_args", values)


def _shipped_configs(arguments: list[str]) -> Iterator[str]:
    """The arguments, with `--config NAME` of a shipped configuration as its path."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag, _, value = argument.rpartition("=")
        if before in ("--config", "-c") or flag == "--config":
            shipped = CONFIGS / f"{value}.yaml"
            value = str(shipped) if shipped.is_file() and not Path(value).exists() else value
        yield f"{flag}={value}" if flag else value


def run(kind: str, arguments: list[str]) -> None:
    """Runs `envtf model ARGUMENTS` or `envtf agent ARGUMENTS`.

    Raises:
        UserError: bad data, weights or checkpoints, or a logger that is not installed.
    """
    try:
        _run(kind, arguments)
    except (ModuleNotFoundError, ValueError) as error:  # jsonargparse wraps what a logger raises
        missing = next((e for e in _causes(error) if isinstance(e, ModuleNotFoundError)), None)
        if missing is None:
            raise
        raise UserError(f"A package is missing: {' '.join(str(missing).split())}") from None
    except RuntimeError as error:
        head, *mismatches = str(error).splitlines()
        if not head.startswith("Error(s) in loading state_dict"):
            raise
        raise UserError(
            f"The checkpoint does not fit the model ({' '.join(mismatches[0].split())}): leave out the flags that "
            "change the architecture, which --ckpt_path brings along."
        ) from None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _run(kind: str, arguments: list[str]) -> None:
    cli, model, data = {"model": (ModelCLI, world_model, LogWindows), "agent": (AgentCLI, agent, LogTransitions)}[kind]
    cli(
        model,
        data,
        args=[*_shipped_configs(arguments)],
        seed_everything_default=0,
        auto_configure_optimizers=False,
        trainer_defaults={
            "default_root_dir": ".envtf",
            "callbacks": [Publish()],
            "use_distributed_sampler": False,  # the samplers share draws among processes themselves
        },
        save_config_callback=KeepConfig,
        save_config_kwargs={"save_to_log_dir": False},
        parser_kwargs={
            "prog": f"envtf {kind}",
            "description": f"{(model.__doc__ or '').splitlines()[0]} {TRUST}",
        },
    )
