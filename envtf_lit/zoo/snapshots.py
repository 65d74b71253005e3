"""The shipped behaviour policies (snapshots along training), and which of them collect a tier's dataset."""

import math
import platform
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.errors import UserError
from envtf_lit.files import read_json, recover
from envtf_lit.model_folders import load_weights
from envtf_lit.robots.hidden_dynamics import HIGH, LOW
from envtf_lit.robots.tasks import ROBOTS, Robot, Task

ZOO = Path(__file__).parent.parent / "assets" / "zoo"
MIN_ROWS = 2  # of a phase and of an episode
NOT_D4RL = "These are not D4RL's files: scores compare among themselves, not with D4RL's tables."
HIDDEN_DYNAMICS = (
    f"friction, mass and actuator strength are drawn in each episode, each uniform in [{LOW}, {HIGH}] times nominal, "
    "and are not observed; the policies were trained, and their returns measured, on the nominal robot"
)


@dataclass(frozen=True)
class Snapshot:
    """A learner's policy after `steps` environment steps, and what its deterministic actions returned."""

    steps: int
    mean_return: float
    return_std: float
    mean_length: float


@dataclass(frozen=True)
class Series:
    """A robot's snapshots along training, as a folder of safetensors and its `zoo.json` hold them.

    Attributes:
        robot: whose observations the snapshots know.
        folder: holds `zoo.json` and, for each snapshot, `<steps>.safetensors`.
        warm_up_steps: uniform random actions with which the learner began.
        trained_with: algorithm and settings, in words.
        architecture: of the `TanhGaussianActor`s.
        snapshots: in the order of their steps.
    """

    robot: Robot
    folder: Path
    warm_up_steps: int
    trained_with: str
    architecture: dict[str, Any]
    snapshots: tuple[Snapshot, ...]

    @cached_property
    def expert(self) -> Snapshot:
        """The snapshot of highest return."""
        return max(self.snapshots, key=lambda snapshot: snapshot.mean_return)

    @cached_property
    def medium(self) -> Snapshot:
        """The snapshot, up to the expert, whose return is nearest to a third of the expert's."""
        third = self.expert.mean_return / 3
        return min(self.up_to(self.expert), key=lambda snapshot: abs(snapshot.mean_return - third))

    def up_to(self, last: Snapshot) -> list[Snapshot]:
        """The snapshots up to `last`, which is included."""
        return [snapshot for snapshot in self.snapshots if snapshot.steps <= last.steps]


def read_series(robot: Robot, zoo: Path | None = None) -> Series:
    """The snapshots of a robot (or of the robot it is a variant of).

    Args:
        robot: any of ours.
        zoo: a folder that `envtf zoo train` wrote; None takes the zoo that is part of this package.

    Raises:
        UserError: that folder has no (or no valid) series of this robot.
    """
    folder = (zoo or ZOO) / robot.name
    recover(folder)
    content = read_json(folder / "zoo.json")
    try:
        snapshots = tuple(Snapshot(**snapshot) for snapshot in content["snapshots"])
        known = {name: content[name] for name in ("warm_up_steps", "trained_with", "architecture")}
        if not snapshots:
            raise KeyError("no snapshots")
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{folder}/zoo.json is not what `envtf zoo train` writes ({error}): train anew.") from None
    return Series(ROBOTS[robot.name], folder, snapshots=snapshots, **known)


def load_snapshot(series: Series, steps: int) -> TanhGaussianActor:
    """The behaviour policy after that many environment steps of training.

    Raises:
        UserError: its file is missing, damaged or of another shape.
    """
    robot = series.robot
    actor = TanhGaussianActor(robot.observation_dim, robot.action_dim, **series.architecture)
    load_weights(actor, series.folder / f"{steps:07d}.safetensors")
    return actor.eval()


@dataclass(frozen=True)
class Phase:
    """Consecutive rows of the dataset that one policy collects.

    Attributes:
        steps: environment steps the snapshot had been trained for; 0 is uniform random actions.
        rows: transitions to collect.
        mean_return: of the snapshot's deterministic actions; None for random actions.
    """

    steps: int
    rows: int
    mean_return: float | None


def plan(task: Task, transitions: int, series: Series | None = None) -> list[Phase]:
    """The policies that collect a task's dataset and the rows of each, in this order.

    - `random`: uniform actions.
    - `medium`: the snapshot whose return is nearest to a third of the expert's.
    - `medium-replay`: the replay buffer of a learner that stops there: its random warm-up, then each snapshot with a
      share equal to the training steps since the snapshot before it.
    - `full-replay`: the same up to the expert, the snapshot of highest return.
    - `medium-expert`: half medium, half expert.
    - `expert`, which is none of the twenty tasks' tiers: the expert alone.

    Args:
        task: robot and tier.
        transitions: rows in all.
        series: the robot's snapshots; None takes the package's.

    Raises:
        UserError: `transitions` is too small to give every policy two rows.
    """
    series = series or read_series(task.robot)
    policies = _policies(task.tier, series)
    ends = np.array(list(accumulate(share for _, share in policies)))
    rows = np.diff(np.rint(ends / ends[-1] * transitions).astype(int), prepend=0)
    if rows.min() < MIN_ROWS:
        least = math.ceil(MIN_ROWS * ends[-1] / min(share for _, share in policies))
        raise UserError(
            f"{transitions} transitions are too few for the {len(policies)} policies of {task.name}: ask for {least} "
            "or more."
        )
    return [
        Phase(snapshot.steps if snapshot else 0, int(count), snapshot.mean_return if snapshot else None)
        for (snapshot, _), count in zip(policies, rows, strict=True)
    ]


def _policies(tier: str, series: Series) -> list[tuple[Snapshot | None, int]]:
    """A tier's policies (None acts at random) and their shares of the rows, in any unit."""
    if tier == "random":
        return [(None, 1)]
    if tier == "medium":
        return [(series.medium, 1)]
    if tier == "expert":
        return [(series.expert, 1)]
    if tier == "medium-expert":
        return [(series.medium, 1), (series.expert, 1)]
    learner = series.up_to(series.medium if tier == "medium-replay" else series.expert)
    ends = [series.warm_up_steps, *(snapshot.steps for snapshot in learner)]
    return list(zip([None, *learner], np.diff(ends, prepend=0).tolist(), strict=True))


def describe_origin(task: Task, transitions: int, seed: int, zoo: Path | None = None) -> dict[str, Any]:
    """How `collect` makes a dataset, for its card: policies with their returns and scores, seed, environment, versions.

    Two datasets of equal origin have equal bytes, on machines that round alike.
    """
    series, robot = read_series(task.robot, zoo), task.robot
    policies = [
        {
            "policy": f"snapshot after {phase.steps:,} steps" if phase.steps else "uniform random",
            "steps": phase.steps,
            "transitions": phase.rows,
            "mean_return_deterministic": phase.mean_return,
            "score_deterministic": None if phase.mean_return is None else robot.normalised_score(phase.mean_return),
        }
        for phase in plan(task, transitions, series)
    ]
    versions = {name: version(name) for name in ("gymnasium", "mujoco", "numpy", "torch")}
    hidden = {"hidden_dynamics": HIDDEN_DYNAMICS} if robot.hidden_dynamics else {}
    return {
        "seed": seed,
        "actions": "stochastic",
        "env_id": robot.env_id,
        "env_kwargs": robot.env_kwargs,
        **hidden,
        "policies": policies,
        "trained_with": series.trained_with,
        "versions": {**versions, "python": platform.python_version()},
        "note": f"Collected in {robot.env_id} by this package's own behaviour policies. {NOT_D4RL}",
    }
