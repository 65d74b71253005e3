"""`envtf model …` and `envtf agent …`: LightningCLI over the classes that the pipeline trains."""

import json
import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import lightning as L
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.plugins.io import TorchCheckpointIO

from envtf_lit.agents.options import NO_WORLD_MODEL
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.cli.arguments import SHIPPED, given, of_today, with_shipped_configs
from envtf_lit.cli.lightning_modules import SOURCES, LogWindows, OnlineTransitions, agent_of, world_model_of
from envtf_lit.cli.publish import KeepConfig, Publish
from envtf_lit.cli.saved_options import (
    checkpoint_class,
    checkpoint_options,
    learned_online,
    model_architecture,
    model_kind,
    policy_architecture,
)
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.options import UPDATES_PER_STEP, DownloadOptions
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.online.evaluation import Evaluation
from envtf_lit.options.schema import build
from envtf_lit.pipeline.params import Params
from envtf_lit.training import Curves, Guard, WholeCheckpoints
from envtf_lit.world_models.options import KINDS, TransformerOptions

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
    tag: str  # the option of the model on which the others depend
    chosen: str  # its value
    options: type[Any]  # the options class that goes with it
    verbs: tuple[str, ...]

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name in self.from_data:
            parser.link_arguments(f"data.{name}", f"model.{name}", apply_on="instantiate")
        for source, target in self.links.items():
            parser.link_arguments(source, target, compute_fn=_plain)
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
        # only now: Lightning would take them for callbacks that save checkpoints, and make none;
        # at the front, so that checkpoints hold the row of their epoch
        trainer.callbacks[:0] = [Guard(), Curves()]  # pyright: ignore[reportAttributeAccessIssue]
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:  # neither a strategy's own nor the user's
            trainer.strategy.checkpoint_io = WholeCheckpoints()
        return trainer

    @staticmethod
    def architecture(folder: str) -> dict[str, Any]:
        """The options that a published folder's weights ask for."""
        raise NotImplementedError

    @staticmethod
    def check(options: Any, held_out: float) -> None:
        """What is a rule for this command alone.

        Raises:
            UserError: it is broken.
        """
        raise NotImplementedError

    def _parse_ckpt_path(self) -> None:
        """Lightning would let the checkpoint's options win over flags; see `parse_arguments`."""

    def before_instantiate_classes(self) -> None:
        config = self.config[str(self.subcommand)]
        options, trainer = config.model.options, config.trainer
        if config.model[self.tag] != self.chosen:
            raise UserError(
                f"model.{self.tag} is {config.model[self.tag]!r} in a place that comes too late: give the flag "
                f"--model.{self.tag}, whole."
            )
        if str(trainer.precision).endswith("-true") and "32" not in str(trainer.precision):
            raise UserError(
                f"trainer.precision is {trainer.precision}, and scales, sums and predictions need more than that many "
                "digits: give 32-true, or bf16-mixed for products of matrices alone."
            )
        if config.ckpt_path == "best":
            raise UserError(
                "--ckpt_path is best, which names a checkpoint of this very run, and it has none yet: give the path of "
                "a checkpoint, or last."
            )
        plain = build(self.options, options.as_dict(), SECTION)
        build(Params, {"seed": config.model.seed}, "model")
        self.check(plain, config.data.held_out)
        if trainer.max_epochs is None and trainer.max_steps == -1:
            trainer.max_epochs = plain.updates // plain.updates_per_epoch
        if trainer.gradient_clip_val is None:  # refused under the agents' manual optimisation, and they have none
            trainer.gradient_clip_val = getattr(plain, "gradient_clip", None)


class ModelCLI(_LinkedCLI):
    """`envtf model`, for one kind of world model."""

    tag = "kind"
    verbs = ("fit", "validate", "test")
    links = {
        "model.seed": "data.seed",
        "model.options.batch_size": "data.batch_size",
        "model.options.updates_per_epoch": "data.updates_per_epoch",
    }

    def link_more(self, parser: LightningArgumentParser) -> None:
        if self.options is TransformerOptions:
            parser.link_arguments("model.options.context", "data.context", compute_fn=_plain)
            parser.link_arguments("model.options.context", "data.members", compute_fn=lambda _: None)
        else:
            parser.link_arguments("model.options.members", "data.context", compute_fn=lambda _: 1)
            parser.link_arguments("model.options.members", "data.members", compute_fn=_plain)

    @staticmethod
    def architecture(folder: str) -> dict[str, Any]:
        return model_architecture(folder)

    @staticmethod
    def check(options: Any, held_out: float) -> None:
        build(DownloadOptions, {"held_out": held_out}, "data")


class AgentCLI(_LinkedCLI):
    """`envtf agent`, for one algorithm."""

    tag = "algorithm"
    verbs = ("fit", "validate")
    from_data = ("observation_dim", "action_dim", "action_low", "action_high")
    links = {f"model.options.{name}": f"data.{name}" for name in ("batch_size", "discount", "n_step")} | {
        "model.options.return_temperature": "data.return_temperature",
        "model.options.fewest_episodes": "data.fewest_episodes",
        "model.seed": "data.seed",
    }

    def link_more(self, parser: LightningArgumentParser) -> None:
        steps = lambda updates: updates // UPDATES_PER_STEP  # noqa: E731
        parser.link_arguments("model.options.updates_per_epoch", "data.steps_per_epoch", compute_fn=steps)

    @staticmethod
    def architecture(folder: str) -> dict[str, Any]:
        return policy_architecture(folder)

    @staticmethod
    def check(options: Any, held_out: float) -> None:
        if held_out != 0.0:
            build(DownloadOptions, {"held_out": held_out}, "data")
        if options.world_model != NO_WORLD_MODEL:
            raise UserError(f"{SECTION}.world_model is {options.world_model}: leave it out, to learn from data alone.")


def _plain(value: float | None) -> float | None:
    """A number of Python's own: those of jsonargparse's types cannot be written to a configuration."""
    return value if value is None else int(value) if isinstance(value, int) else float(value)


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
    arguments = of_today(with_shipped_configs(arguments))
    if kind == "model":
        name = _chosen("kind", arguments, KINDS, "transformer")
        cli, model, data, options = ModelCLI, world_model_of(name), LogWindows, KINDS[name]
    else:
        classes = {name: algorithm.Options for name, algorithm in ALGORITHMS.items()}
        name = _chosen("algorithm", arguments, classes, "cql")
        if ALGORITHMS[name].imagines:
            raise UserError(f"{name} needs a world model: add it below train_policy in params.yaml, and `dvc repro`.")
        cli, model, data, options = AgentCLI, agent_of(name), _source(arguments), classes[name]
    made = type(cli.__name__, (cli,), {"options": options, "chosen": name})
    made(
        model,
        data,
        args=arguments,
        seed_everything_default=0,
        auto_configure_optimizers=False,
        trainer_defaults={
            "default_root_dir": ".envtf",
            "callbacks": [Publish(), *([Evaluation()] if data is OnlineTransitions else [])],
            "use_distributed_sampler": False,  # the samplers share draws among processes themselves
        },
        save_config_callback=KeepConfig,
        save_config_kwargs={"save_to_log_dir": False},
        parser_kwargs={
            "prog": f"envtf {kind}",
            "description": f"{(model.__doc__ or '').splitlines()[0]} {TRUST}",
        },
    )


def _source(arguments: list[str]) -> type[TransitionData]:
    """The data module of `--data.source`, on which the other options of the data depend.

    Raises:
        UserError: it is unknown, or a run that learned online shall go on without.
    """
    source, checkpoint = given("data.source", arguments) or "file", given("ckpt_path", arguments)
    if source not in SOURCES:
        raise UserError(f"--data.source is {source!r}: {did_you_mean(source, SOURCES)}")
    if source != "online" and checkpoint is not None and learned_online(checkpoint):
        raise UserError(f"{checkpoint} is of a run that learns online: add --data.source online, and its data's flags.")
    return SOURCES[source]


def _chosen(tag: str, arguments: list[str], classes: Mapping[str, type], default: str) -> str:
    """The value of `--model.TAG`, on which the other options depend: as given, or else that of what is started from.

    Raises:
        UserError: it is unknown, or another one than that of the checkpoint or the folder.
    """
    flag, asked, brought = f"--model.{tag}", given(f"model.{tag}", arguments), None
    if asked is not None and asked not in classes:
        raise UserError(f"{flag} is {asked!r}: {did_you_mean(asked, classes)}")
    checkpoint, base = given("ckpt_path", arguments), given("model.init_from", arguments)
    if checkpoint is not None and not LIGHTNINGS_OWN.match(checkpoint):
        brought = checkpoint_class(checkpoint, classes)
    elif base is not None and classes is KINDS:  # an actor is the same whatever trained it
        brought = model_kind(base)
    if asked is not None and brought not in (None, asked):
        raise UserError(
            f"{flag} is {asked}, and {checkpoint or base} is of the {tag} {brought}: give {flag} {brought}."
        )
    return asked or brought or default
