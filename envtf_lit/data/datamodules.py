"""Lightning's data modules: windows of a log for world models, transitions for agents."""

from collections.abc import Iterable
from functools import cached_property

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import (
    DrawnRows,
    DrawSampler,
    Resamples,
    ReturnWeights,
    Transitions,
    Windows,
    effective_episodes,
    epoch_generator,
)
from envtf_lit.data.options import UPDATES_PER_STEP
from envtf_lit.data.sources.files import load_dataset


def _loader(dataset: Dataset[dict[str, Tensor]], draws: Iterable[Tensor]) -> DataLoader[dict[str, Tensor]]:
    """Batches of whole draws; its own generator, since a DataLoader takes a number from the global one per epoch."""
    return DataLoader(dataset, sampler=draws, batch_size=None, generator=torch.Generator())


def _device(data: L.LightningDataModule) -> torch.device:
    """Where the trainer works, if there is one."""
    return torch.device("cpu") if data.trainer is None else data.trainer.strategy.root_device


def _process(data: L.LightningDataModule) -> tuple[int, int]:
    """Which of how many processes this one is."""
    return (0, 1) if data.trainer is None else (data.trainer.global_rank, data.trainer.world_size)


class WindowData(L.LightningDataModule):
    """Windows for world models, with whole episodes held out for validation and test.

    Args:
        path: dataset file, HDF5 or NPZ.
        context: steps per window; the model's context.
        batch_size: windows per batch and process.
        updates_per_epoch: batches per epoch.
        held_out: share of the episodes kept for validation and test, half each, where the dataset does not say which.
        seed: of all draws, and of that split.
        members: of an ensemble, each of which has its own bootstrap resample of the training windows; its batches come
            first in the shape, (members, batch_size, context, …). None gives plain windows.
    """

    train: OfflineDataset
    held_out: OfflineDataset
    validation: OfflineDataset
    test: OfflineDataset

    def __init__(
        self,
        path: str,
        context: int = 32,
        batch_size: int = 32,
        updates_per_epoch: int = 1_000,
        held_out: float = 0.1,
        seed: int = 0,
        members: int | None = None,
    ) -> None:
        super().__init__()
        self.path, self.context, self.batch_size, self.members = path, context, batch_size, members
        self.updates_per_epoch, self.share, self.seed = updates_per_epoch, held_out, seed
        self.dataset = self.read(path)
        self.observation_dim, self.action_dim = self.dataset.observation_dim, self.dataset.action_dim

    def read(self, path: str) -> OfflineDataset:
        """The dataset of that path; the command line has more sources."""
        return load_dataset(path)

    def setup(self, stage: str) -> None:
        """Splits the dataset; called by Lightning."""
        self.train, self.held_out = self.dataset.split(self.share, seed=self.seed)
        self.validation, self.test = self.held_out.validation_and_test()

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """Batches (B, T, …) of `Windows`, or (M, B, T, …) of `Resamples`."""
        windows = Windows(self.train, self.context, _device(self))
        shape = (self.batch_size,) if self.members is None else (self.members, self.batch_size)
        sampler = DrawSampler(len(windows), shape, self.updates_per_epoch, seed=self.seed, process=_process(self))
        return _loader(windows if self.members is None else Resamples(windows, self.members, seed=self.seed), sampler)

    def val_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """Each row once of the episodes for validation; of several processes, every one sees them all."""
        return self._tiles(self.validation)

    def test_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """The same of the episodes for testing, which neither choose a model nor fit its intervals."""
        return self._tiles(self.test)

    def _tiles(self, episodes: OfflineDataset) -> DataLoader[dict[str, Tensor]]:
        windows = Windows(episodes, self.context, _device(self))
        return _loader(windows, windows.tiles().split(256))

    def training_tiles(self, rows: int) -> DataLoader[dict[str, Tensor]]:
        """Each training row once, or some `rows` of them, drawn as whole windows."""
        windows = Windows(self.train, self.context)
        tiles = windows.tiles()
        order = torch.randperm(len(tiles), generator=epoch_generator(self.seed, 0, "tiles"))
        kept = max(1, round(len(tiles) * min(1.0, rows / len(self.train))))
        return _loader(windows, tiles[order[:kept]].split(256))


class TransitionData(L.LightningDataModule):
    """Transitions for agents, several batches at a time.

    Attributes:
        chances: (N,) of each row, beside those of `ReturnWeights`; None for equal ones. An agent may set them.
        dataset: what is learned from.
        validation: that half of the held-out episodes which may choose between actors; None where all are learned from.

    Args:
        path: dataset file, HDF5 or NPZ.
        batch_size: rows per gradient step and process.
        steps_per_epoch: Lightning training steps per epoch.
        discount: of future rewards, per step.
        n_step: steps whose rewards enter the temporal-difference target.
        return_temperature: of `ReturnWeights`; None draws rows uniformly.
        fewest_episodes: likewise.
        held_out: 0 takes all episodes; more leaves out those that the dataset says are held out, else that share of
            them, the ones that `WindowData` holds out with the same share and seed.
        seed: of all draws, and of that split.
    """

    chances: Tensor | None
    dataset: OfflineDataset
    validation: OfflineDataset | None

    def __init__(
        self,
        path: str,
        batch_size: int = 256,
        steps_per_epoch: int = 50,
        discount: float = 0.99,
        n_step: int = 1,
        return_temperature: float | None = None,
        fewest_episodes: int = 20,
        held_out: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.batch_size, self.steps_per_epoch = batch_size, steps_per_epoch
        self.discount, self.n_step, self.seed = discount, n_step, seed
        self.return_temperature, self.fewest_episodes = return_temperature, fewest_episodes
        self.chances = None
        self.dataset, self.validation = self.read(path), None
        if held_out > 0:
            self.dataset, unseen = self.dataset.split(held_out, seed=seed)
            self.validation = unseen.validation_and_test()[0]
        self.observation_dim, self.action_dim = self.dataset.observation_dim, self.dataset.action_dim
        self.action_low, self.action_high = self.dataset.action_low.tolist(), self.dataset.action_high.tolist()

    def read(self, path: str) -> OfflineDataset:
        """The dataset of that path; the command line has more sources."""
        return load_dataset(path)

    @cached_property
    def transitions(self) -> Transitions:
        """All rows of the dataset, with their n-step targets and returns to go."""
        return Transitions(self.dataset, discount=self.discount, n_step=self.n_step, device=_device(self))

    @cached_property
    def weights(self) -> Tensor | None:
        """(N,) chances of each row, up to a factor; None where they are equal."""
        if self.return_weights is None:
            return self.chances
        weights = self.return_weights(self.dataset)
        return weights if self.chances is None else weights * self.chances

    @cached_property
    def return_weights(self) -> ReturnWeights | None:
        """How an episode's return weighs its rows; None where it does not."""
        if self.return_temperature is None:
            return None
        return ReturnWeights.of(self.dataset, self.return_temperature, self.fewest_episodes)

    @cached_property
    def validation_rows(self) -> DrawnRows | None:
        """Rows of held-out episodes, drawn by the same rule as those of training; None where all are learned from."""
        if self.validation is None:
            return None
        weights = None if self.return_weights is None else self.return_weights(self.validation)
        rows = Transitions(self.validation, discount=self.discount, n_step=self.n_step, device=_device(self))
        return DrawnRows(rows, weights, _device(self))

    @cached_property
    def effective_episodes(self) -> float:
        """How many episodes rows come from, each counted by its share (`loaders.effective_episodes`)."""
        weights = torch.ones(len(self.dataset)) if self.weights is None else self.weights
        return effective_episodes(self.dataset, weights)

    def train_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """Batches (UPDATES_PER_STEP, batch_size, …) of `Transitions`."""
        shape, weights = (UPDATES_PER_STEP, self.batch_size), self.weights
        rows, process = len(self.transitions), _process(self)
        sampler = DrawSampler(rows, shape, self.steps_per_epoch, seed=self.seed, weights=weights, process=process)
        return _loader(self.transitions, sampler)

    def val_dataloader(self) -> DataLoader[dict[str, Tensor]]:
        """Each row once, in the log's order, in batches (4096, …)."""
        return _loader(self.transitions, torch.arange(len(self.transitions)).split(4096))
