"""`envtf model …` and `envtf agent …`: LightningCLI over the classes that the pipeline trains."""

import json
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import lightning as L
import torch
from jsonargparse import Namespace
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from envtf_lit.agents.options import PolicyOptions, check_no_imagination, check_policy
from envtf_lit.cli.components import LogTransitions, LogWindows, agent, world_model
from envtf_lit.cli.publish import KeepConfig, Publish
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.options.schema import build_section
from envtf_lit.pipeline.params import Params
from envtf_lit.training import Curves
from envtf_lit.world_models.lit import window_options
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
    "folder `published`, whose path is printed. --config takes a file, or the name of one that comes along: "
    f"{SHIPPED}."
)

SECTION = "model.options"  # of the command line, which errors name
LIGHTNINGS_OWN = re.compile(r"(best|last|hpc|registry.*|\w+://.*)$")  # checkpoints that are not local paths


class _LinkedCLI(LightningCLI):
    """Takes dimensions from the dataset, asks only once for what model and data share, and stops when updates say."""

    from_data: tuple[str, ...] = ("observation_dim", "action_dim")
    links: dict[str, str]
    options: type[TrainModelOptions] | type[PolicyOptions]
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
                below = _saved_options(checkpoint, self.options)
            elif base is not None:
                below = {"options": self.architecture(read_json(Path(base) / "config.json"))}
            else:
                return
            begin = args.index(verb) + 1  # below flags: the first --config
            super().parse_arguments(parser, [*args[:begin], "--config", json.dumps({"model": below}), *args[begin:]])

    def instantiate_trainer(self, **kwargs: Any) -> L.Trainer:
        trainer = super().instantiate_trainer(**kwargs)
        # only now: Lightning would take it for the callback that saves checkpoints, and make none;
        # at the front, so that checkpoints hold the row of their epoch
        trainer.callbacks.insert(0, Curves())  # pyright: ignore[reportAttributeAccessIssue]
        return trainer

    @staticmethod
    def architecture(config: dict[str, Any]) -> dict[str, Any]:
        """The options that a published folder's weights ask for, given its config.json."""
        raise NotImplementedError

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
    verbs = ("fit", "validate", "test")
    links = {"model.options.held_out": "data.held_out", "model.seed": "data.seed"}

    @staticmethod
    def architecture(config: dict[str, Any]) -> dict[str, Any]:
        arguments = _arguments(config, ("observation_dim", "action_dim"))
        return {"ensemble": arguments} if config.get("kind") == "ensemble_dynamics" else {"model": arguments}

    @staticmethod
    def check(options: TrainModelOptions) -> None:
        check_world_model(options, SECTION)

    def link_more(self, parser: LightningArgumentParser) -> None:
        for name in ("context", "batch_size", "updates_per_epoch", "members"):
            parser.link_arguments("model.options", f"data.{name}", compute_fn=_window_option(name))


class AgentCLI(_LinkedCLI):
    """`envtf agent`."""

    options = PolicyOptions
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
    def architecture(config: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in _arguments(config).items() if name == "hidden"}

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


def _saved_options(checkpoint: str, kind: type[TrainModelOptions] | type[PolicyOptions]) -> dict[str, Any]:
    """The options, of this kind, and the seed that a Lightning checkpoint was trained with.

    Raises:
        UserError: the file is missing or is not such a checkpoint.
    """
    try:
        saved = torch.load(checkpoint, map_location="cpu", weights_only=True)["hyper_parameters"]
        if not saved["options"].keys() <= {field.name for field in fields(kind)}:
            raise KeyError
        return {name: saved[name] for name in ("options", "seed", "freeze")}
    except FileNotFoundError:
        raise UserError(f"{checkpoint} does not exist: give --ckpt_path a checkpoint of an earlier fit.") from None
    except Exception:  # whatever unpickling raises; torch's own message recommends to run code found in the file
        raise UserError(
            f"{checkpoint} is not a checkpoint of this model: give --ckpt_path a file that fit wrote."
        ) from None


def _arguments(config: dict[str, Any], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """The constructor's arguments in a published folder's config.json; an odd file is for the loader to refuse."""
    arguments = config.get("arguments") if isinstance(config, dict) else None
    return {name: value for name, value in (arguments or {}).items() if name not in without}


def _shipped_configs(arguments: list[str]) -> Iterator[str]:
    """The arguments, with `--config NAME` of a shipped configuration as its path."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag, _, value = argument.rpartition("=")
        if before in ("--config", "-c") or flag == "--config":
            shipped = CONFIGS / f"{value}.yaml"
            value = str(shipped) if shipped.is_file() and not Path(value).exists() else value
        yield f"{flag}={value}" if flag else value


CLASSES = {"model": (ModelCLI, world_model, LogWindows), "agent": (AgentCLI, agent, LogTransitions)}


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
    cli, model, data = CLASSES[kind]
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
