"""What `envtf model …` and `envtf agent …` train, and what they read: the signatures are the command lines."""

from collections.abc import Callable
from functools import cache
from typing import Any, Literal

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.files import load_dataset
from envtf_lit.data.sources.minari import read_minari
from envtf_lit.online.data import OnlineData
from envtf_lit.world_models.lit import LitWorldModel, lit_world_model
from envtf_lit.world_models.options import KINDS


@cache  # jsonargparse wants one function of a name
def world_model_of(kind: str) -> Callable[..., LitWorldModel]:
    """The function whose signature is `envtf model`, for one kind of world model."""
    Options: Any = KINDS[kind]

    def world_model(
        observation_dim: int,
        action_dim: int,
        options: Options = Options(),  # noqa: B008 (frozen)  # pyright: ignore[reportInvalidTypeForm]
        kind: str = kind,
        seed: int = 0,
        init_from: str | None = None,
        freeze: list[str] = [],  # noqa: B006 (read alone)
        compile: bool = False,
    ) -> LitWorldModel:
        """Environment Transformer, or the usual ensemble, trained on windows of a log.

        Args:
            observation_dim: S, taken from the data.
            action_dim: A, taken from the data.
            options: as a section below train_model in params.yaml.
            kind: transformer or ensemble.
            seed: of dropout and of sampled objectives.
            init_from: a published model folder (as models/world_model/transformer) whose weights to start from. Scales
                are those of the new data; projections to and from another robot's dimensions begin anew.
            freeze: parts of the model that stay as they are: embed, blocks, blocks.0, norm, head, …
            compile: fuses the operations of the training loss by torch.compile, which pays on a GPU.
        """
        return lit_world_model(observation_dim, action_dim, options, seed, init_from, freeze, compile)

    world_model.__qualname__ = f"world_model_{kind}"
    return world_model


@cache
def agent_of(algorithm: str) -> Callable[..., Agent]:
    """The function whose signature is `envtf agent`, for one algorithm that learns from data alone."""
    cls = ALGORITHMS[algorithm]
    Options: Any = cls.Options

    def agent(
        observation_dim: int,
        action_dim: int,
        options: Options = Options(),  # noqa: B008 (frozen)  # pyright: ignore[reportInvalidTypeForm]
        algorithm: str = algorithm,
        action_low: list[float] | None = None,
        action_high: list[float] | None = None,
        seed: int = 0,
        init_from: str | None = None,
        freeze: list[str] = [],  # noqa: B006 (read alone)
    ) -> Agent:
        """A policy, trained on a log alone.

        Args:
            observation_dim: S, taken from the data.
            action_dim: A, taken from the data.
            options: as policy, and a section below train_policy, in params.yaml.
            algorithm: which, such as cql or bc.
            action_low: (A,), taken from the data.
            action_high: (A,), taken from the data.
            seed: of everything random.
            init_from: a published policy folder (as models/policy/cql) whose actor to start from, with the scales of
                the new data; layers for another robot's dimensions begin anew. Such folders hold no critics, so these
                start anew, and the warm start fits them alone.
            freeze: parts of the actor that stay as they are: net.0, net.2, …
        """
        return cls(
            observation_dim,
            action_dim,
            options,
            action_low=action_low,
            action_high=action_high,
            seed=seed,
            init_from=init_from,
            freeze=freeze,
        )

    agent.__qualname__ = f"agent_{algorithm}"
    return agent


class _Sourced:
    """Reads a dataset from where `source` says."""

    def __init__(self, path: str, source: Literal["file", "minari"] = "file", **options: Any) -> None:
        self.source = source
        super().__init__(path, **options)  # pyright: ignore[reportCallIssue]  # of the data module beside it

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


class LogTransitions(_Sourced, TransitionData):
    """Transitions of a log, for agents.

    Args:
        path: dataset file, HDF5 or NPZ, or a Minari dataset's id or folder.
        source: which of the two: `file` or `minari`. With `online` there are other options: add it to see them.
        options: see `TransitionData`.
    """


class OnlineTransitions(OnlineData):
    """An agent's own experience in an environment, and a log's rows beside it.

    Args:
        source: `online`.
        options: see `OnlineData`.
    """

    def __init__(self, source: Literal["online"] = "online", **options: Any) -> None:
        self.source = source
        super().__init__(**options)


SOURCES: dict[str, type[TransitionData]] = {
    "file": LogTransitions,
    "minari": LogTransitions,
    "online": OnlineTransitions,
}
