"""One run of the grid: a policy is trained, scored along the way and at the end, and becomes a row of results."""

import copy
import re
import time
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Checkpoint

from envtf_lit.agents.agent import Agent
from envtf_lit.comparison.grid import Cell
from envtf_lit.comparison.records import Evaluation, Run
from envtf_lit.comparison.settings import cell_params
from envtf_lit.comparison.shared import Home
from envtf_lit.devices import pick_device
from envtf_lit.divergence import Diverged
from envtf_lit.files import write_text
from envtf_lit.pipeline.stage import POLICIES
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.policy import Policy, load_policy
from envtf_lit.robots.returns import Returns, evaluate_policy
from envtf_lit.studies.machine import code_version, hardware, peak_memory_mb

LAST = 10  # evaluations along the way whose mean is `score_last10`
# Episodes begin from other seeds for each training seed and for each data seed (development and reporting), and along
# the way from others than at the end, but from the same ones for every algorithm.
TRAINING_SEEDS, DATA_SEEDS, ALONG = 1_000, 1_000_000, 500


def evaluation_seed(cell: Cell) -> int:
    """Base of the seeds of the episodes at the end of a run; those along the way begin `ALONG` later."""
    return TRAINING_SEEDS * cell.seed + DATA_SEEDS * cell.budget.data_seed


class Scores(Checkpoint):
    """Scores the averaged actor after each epoch, and times the epochs; part of the training's checkpoints.

    A `Checkpoint` by type alone, to be called for sound epochs alone (see `trained`).

    Attributes:
        points: (updates, mean score) of the evaluations so far.
        seconds: of the epochs so far, evaluations left out.
        kept: the actor of the last evaluation; before the first, that which training began or went on with.

    Args:
        cell: the run.
    """

    kept: Policy

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.points: list[tuple[int, float]] = []
        self.seconds = 0.0

    @property
    def updates(self) -> int:
        """That `kept` was trained for."""
        return self.points[-1][0] if self.points else 0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._keep(pl_module)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.begin = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._keep(pl_module)  # off the device, which waits for all that it was given to do
        self.seconds += time.perf_counter() - self.begin
        found = score(self.kept, self.cell, self.cell.budget.curve_episodes, evaluation_seed(self.cell) + ALONG)
        updates = (trainer.current_epoch + 1) * self.cell.budget.updates_per_epoch
        self.points.append((updates, float(found.scores.mean())))

    def _keep(self, module: L.LightningModule) -> None:
        assert isinstance(module, Agent)
        self.kept = copy.deepcopy(module.average_actor).cpu().eval()

    def state_dict(self) -> dict[str, Any]:
        return {"points": [list(point) for point in self.points], "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.points = [(int(updates), float(found)) for updates, found in state_dict["points"]]
        self.seconds = state_dict["seconds"]


def score(policy: Policy, cell: Cell, episodes: int, seed: int) -> Returns:
    """A policy's episodes in MuJoCo."""
    return evaluate_policy(policy, cell.machine, episodes=episodes, seed=seed, progress=False)


def run_cell(cell: Cell, work: Path) -> tuple[Run, list[Evaluation]]:
    """Trains and scores a policy; one that was killed goes on from its last evaluation.

    A training that diverges is an outcome, too: what is scored is the last sound policy that was scored on the way.

    Args:
        cell: the run.
        work: folder of what the runs share, which must be there.

    Returns:
        The row of results, and the curve.

    Raises:
        UserError: what the stage `train_policy` raises, but for divergence.
    """
    home, name, scores = Home(cell.task, cell.budget, work).path, section_of(cell), Scores(cell)
    try:
        train_policy(cell_params(cell, name), home, name=name, callbacks=[scores], progress=False)
        policy = load_policy(home / POLICIES / name)
    except Diverged as error:
        write_text(home / "diverged" / f"{name}.txt", f"{error}\n")
        policy = scores.kept
    final = score(policy, cell, cell.budget.episodes, evaluation_seed(cell)).scores
    along = [found for _, found in scores.points] or [float(final.mean())]
    run = Run(
        *cell.key,
        updates=scores.updates,
        score_final=round(float(final.mean()), 3),
        score_last10=round(fmean(along[-LAST:]), 3),
        score_best=round(max(*along, float(final.mean())), 3),
        score_weighted_bc=None,
        episodes=len(final),
        seconds=round(scores.seconds, 1),
        memory_mb=round(peak_memory_mb(), 1),
        device=hardware(pick_device())["device"],
        commit=code_version(),
    )
    return run, [Evaluation(*cell.key, updates=updates, score=round(found, 3)) for updates, found in scores.points]


def section_of(cell: Cell) -> str:
    """What the run's policy is called in its home, below `train_policy` and in `models/policy`."""
    return re.sub(r"[^\w-]+", "-", f"{cell.kit}-{cell.algorithm}-{cell.seed}-{cell.budget}")
