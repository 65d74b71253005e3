"""What a model of a governed machine's log promises whoever opens the governor, and what they get."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pandas as pd
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.rollouts import imagine
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.termination import never_terminated
from envtf_lit.studies.narrow_logs import MACHINES, Machine, driver, simulator
from envtf_lit.world_models.interface import WorldModel

GOVERNED = replace(MACHINES["governed"], odometer=False)  # a model needs no odometer to be misled
HISTORY = 16  # recorded steps before each rollout, at most


class Driven:
    """A policy of what acts on observations (B, S), such as a machine's driver."""

    def __init__(self, act: Callable[[Tensor], Tensor]) -> None:
        self._act = act

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """Observations (B, S) to actions (B, A)."""
        with torch.no_grad():
            return self._act(observation)


def promises(
    model: WorldModel,
    log: OfflineDataset,
    machine: Machine,
    limit: float,
    governors: Sequence[float],
    *,
    starts: int,
    steps: int,
    seed: int,
) -> pd.DataFrame:
    """What a model promises of a machine whose governor is set higher and higher, and what comes in truth.

    Args:
        model: trained on the log, on the CPU.
        log: of `make_log`.
        machine: the log's.
        limit: speed in m/s beyond which ruin begins, which `make_log` tells.
        governors: speeds in m/s.
        starts: rollouts, from rows of the log.
        steps: of each rollout.
        seed: of these rows, and of the true episode's start.

    Returns:
        A row for each speed: `speed`, `promised` and `true` mean reward of a step, and `halted`, the share of rollouts
        that a novelty limit of 1 ends.
    """
    begin = BranchPoints(log).draw(starts, HISTORY, torch.Generator().manual_seed(seed))
    rows = []
    for speed in governors:
        policy = Driven(driver(replace(machine, governor=speed)))
        run, cut = (
            imagine(
                model,
                policy,
                begin,
                horizon=0,
                expansion=steps,
                terminated=never_terminated,
                novelty_limit=novelty,
            )
            for novelty in (None, 1.0)
        )
        played = evaluate_policy(policy, simulator(machine, limit), episodes=1, seed=seed, progress=False)
        true, promised = float(played.returns[0] / played.lengths[0]), float(run.rewards[run.valid].mean())
        rows.append((speed, promised, true, float(cut.halted.any(0).double().mean())))
    return pd.DataFrame(rows, columns=["speed", "promised", "true", "halted"])
