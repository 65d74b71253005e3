"""`envtf model …` and `envtf agent …`: LightningCLI over the classes that the pipeline trains."""

import warnings
from typing import Any

from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from envtf_lit.agents.cql import CQL
from envtf_lit.data.loaders import TransitionData, WindowData
from envtf_lit.params import PolicyOptions, TrainModelOptions
from envtf_lit.world_models.lit import LitWorldModel

TRUST = (
    "A --config file is trusted like code: it may name any class to run, so take one only from where you would take a "
    "program. Weights (--model.init_from) hold data alone."
)


def world_model(
    observation_dim: int,
    action_dim: int,
    options: TrainModelOptions = TrainModelOptions(),  # noqa: B008 (frozen)
    seed: int = 0,
    init_from: str | None = None,
) -> LitWorldModel:
    """Environment Transformer, trained on windows of a log.

    Args:
        observation_dim: S, taken from the data.
        action_dim: A, taken from the data.
        options: as train_model in params.yaml.
        seed: of dropout and of sampled objectives.
        init_from: a published model folder whose weights to start from.
    """
    return LitWorldModel(observation_dim, action_dim, options, seed, init_from)


def agent(
    observation_dim: int,
    action_dim: int,
    options: PolicyOptions = PolicyOptions(),  # noqa: B008 (frozen)
    seed: int = 0,
) -> CQL:
    """Conservative Q-Learning on a log alone.

    Args:
        observation_dim: S, taken from the data.
        action_dim: A, taken from the data.
        options: as train_policy.cql in params.yaml.
        seed: of everything random.
    """
    return CQL(observation_dim, action_dim, options, seed=seed)


class _LinkedCLI(LightningCLI):
    """Takes dimensions from the dataset, asks only once for what model and data share, and stops when updates say."""

    links: dict[str, str]
    verbs: tuple[str, ...]

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name in ("observation_dim", "action_dim"):
            parser.link_arguments(f"data.{name}", f"model.{name}", apply_on="instantiate")
        for source, target in self.links.items():
            parser.link_arguments(source, target)
        self.link_more(parser)

    def link_more(self, parser: LightningArgumentParser) -> None:
        """Links that take a computation."""

    def subcommands(self) -> dict[str, set[str]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return {verb: skipped for verb, skipped in LightningCLI.subcommands().items() if verb in self.verbs}

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        with warnings.catch_warnings():  # these are this command's arguments, whatever stands in sys.argv
            warnings.filterwarnings("ignore", "LightningCLI's args parameter")
            super().parse_arguments(parser, args)

    def before_instantiate_classes(self) -> None:
        config = self.config[str(self.subcommand)]
        options, trainer = config.model.options, config.trainer
        if trainer.max_epochs is None and trainer.max_steps == -1:
            trainer.max_epochs = max(1, options.updates // options.updates_per_epoch)
        if trainer.gradient_clip_val is None:  # refused under the agents' manual optimisation, and they have none
            trainer.gradient_clip_val = getattr(options, "gradient_clip", None)


class ModelCLI(_LinkedCLI):
    """`envtf model`."""

    verbs = ("fit", "validate", "test")
    links = {
        "model.options.model.context": "data.context",
        "model.options.batch_size": "data.batch_size",
        "model.options.updates_per_epoch": "data.updates_per_epoch",
        "model.options.held_out": "data.held_out",
        "model.seed": "data.seed",
    }


class AgentCLI(_LinkedCLI):
    """`envtf agent`."""

    verbs = ("fit", "validate")
    links = {
        "model.options.batch_size": "data.batch_size",
        "model.options.updates_per_step": "data.updates_per_step",
        "model.options.discount": "data.discount",
        "model.seed": "data.seed",
    }

    def link_more(self, parser: LightningArgumentParser) -> None:
        updates = ("model.options.updates_per_epoch", "model.options.updates_per_step")
        parser.link_arguments(updates, "data.steps_per_epoch", compute_fn=lambda epoch, step: max(1, epoch // step))


def run(kind: str, arguments: list[str]) -> None:
    """Runs `envtf model ARGUMENTS` or `envtf agent ARGUMENTS`."""
    cli, model, data = {"model": (ModelCLI, world_model, WindowData), "agent": (AgentCLI, agent, TransitionData)}[kind]
    cli(
        model,
        data,
        args=arguments,
        seed_everything_default=0,
        auto_configure_optimizers=False,
        trainer_defaults={"default_root_dir": ".envtf"},
        save_config_kwargs={"overwrite": True},
        parser_kwargs={"prog": f"envtf {kind}", "description": f"{(model.__doc__ or '').splitlines()[0]} {TRUST}"},
    )
