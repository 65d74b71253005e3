"""Learned termination: a classifier of next states, fitted to the log of a robot whose rule is not known.

The robots of the twenty tasks have their rules in `envtf_lit.robots.termination`; this is for data of one's own.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.data.columns import column_blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import epoch_generator
from envtf_lit.model_folders import load_module, save_module
from envtf_lit.robots.tasks import get_task
from envtf_lit.robots.termination import never_terminated

HIDDEN, UPDATES, BATCH, LEARNING_RATE = 64, 2_000, 256, 0.003


class TerminationHead(nn.Module):
    """Binary classifier of next observations: terminated or not.

    Attributes:
        mean, std: (S,) of the training data's next observations; see `Moments.scale` for constant dimensions.
        threshold: log-odds above which a row counts as terminated: over the training rows, as often as they were.
    """

    mean: Tensor
    std: Tensor
    threshold: Tensor

    def __init__(self, observation_dim: int) -> None:
        super().__init__()
        self.observation_dim = observation_dim
        self.layers = nn.Sequential(
            nn.Linear(observation_dim, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 1)
        )
        self.register_buffer("mean", torch.zeros(observation_dim))
        self.register_buffer("std", torch.ones(observation_dim))
        self.register_buffer("threshold", torch.zeros(()))

    def forward(self, next_observation: Tensor) -> Tensor:
        """(..., S) to the log-odds (...) that the task ended there, if every other row did."""
        return self.layers((next_observation - self.mean) / self.std).squeeze(-1)

    @torch.no_grad()
    def terminated(self, next_observation: Tensor) -> Tensor:
        """(..., S) to bool (...); a state that isn't finite counts as terminated."""
        return ~(self(next_observation) <= self.threshold)

    def fit(self, training: OfflineDataset, *, seed: int) -> None:
        """Fits the classifier to a log in which some rows terminated and some did not.

        Falls are rare, so half of each batch is drawn from them, and their true share sets the threshold instead. A
        truncated episode's last row is one that did not terminate.
        """
        generator = epoch_generator(seed, 0, "termination")
        columns = training.next_observations
        found = training.statistics.next_observations
        self.mean.copy_(found.mean)
        self.std.copy_(found.scale)
        ended, going = np.flatnonzero(training.terminated), np.flatnonzero(~training.terminated)
        label = (torch.arange(BATCH) < BATCH // 2).float()
        optimizer = torch.optim.AdamW(self.layers.parameters(), lr=LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, UPDATES)
        for _ in range(UPDATES):
            drawn = [rows[torch.randint(len(rows), (BATCH // 2,), generator=generator)] for rows in (ended, going)]
            logits = self(torch.as_tensor(columns[np.concatenate(drawn)]))
            optimizer.zero_grad()
            F.binary_cross_entropy_with_logits(logits, label).backward()
            optimizer.step()
            schedule.step()
        self.threshold.copy_(self._log_odds(training).kthvalue(len(going)).values)

    @torch.no_grad()
    def _log_odds(self, dataset: OfflineDataset) -> Tensor:
        """(N,) of every row."""
        columns = dataset.next_observations
        return torch.cat([self(torch.as_tensor(columns[rows])) for rows in column_blocks(columns)])

    def scores(self, held_out: OfflineDataset) -> dict[str, float]:
        """Recall and false-alarm rate on other episodes.

        Returns:
            `termination_false_alarms`, the share of rows that did not terminate and are predicted to; and, if any row
            terminated, `termination_recall`, the share of those that are found.
        """
        predicted, terminated = (self._log_odds(held_out) > self.threshold).numpy(), held_out.terminated
        found = {"termination_false_alarms": float(predicted[~terminated].mean())}
        if terminated.any():
            found["termination_recall"] = float(predicted[terminated].mean())
        return found


def learn_termination(training: OfflineDataset, *, seed: int) -> TerminationHead | None:
    """A fitted classifier, or None where no row terminated (or every row did): there is nothing to learn."""
    if not 0 < training.terminated.sum() < len(training):
        return None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(epoch_generator(seed, 0, "termination weights").initial_seed())
        head = TerminationHead(training.observation_dim)
    head.fit(training, seed=seed)
    return head.eval()


def save_termination(folder: str | Path, head: TerminationHead) -> None:
    """Writes `weights.safetensors` and `config.json`."""
    save_module(folder, head, kind="termination_head", arguments={"observation_dim": head.observation_dim})


def load_termination(folder: str | Path) -> TerminationHead:
    """The classifier saved in a folder, in eval mode.

    Raises:
        UserError: the folder is missing, damaged, or holds something else.
    """
    return load_module(folder, {"termination_head": TerminationHead}).requires_grad_(False)


TERMINATION = "termination"  # below the world model, where it had to be learned


def termination_source(task: str | None, model: Path) -> Literal["rule", "learned", "none"]:
    """What ends imagined rollouts.

    Args:
        task: robot and tier, whose rule is known; None for a robot of one's own.
        model: folder of the world model, which may hold a learned head.

    Returns:
        `rule` of the robot, `learned` head, or `none`: at their horizon alone.
    """
    if task is not None:
        return "rule"
    return "learned" if (model / TERMINATION).exists() else "none"


def termination_rule(task: str | None, model: Path, device: torch.device) -> Callable[[Tensor], Tensor]:
    """Termination function of imagined rollouts: next observations (..., S) to bool (...).

    Args:
        task, model: as of `termination_source`.
        device: of the observations.
    """
    match termination_source(task, model):
        case "rule":
            return get_task(str(task)).robot.terminated
        case "learned":
            return load_termination(model / TERMINATION).to(device).terminated
        case "none":
            return never_terminated
