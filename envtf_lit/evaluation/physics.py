"""Physics: MuJoCo restarted at observations, for the true outcome there and the ceiling of any model's horizon.

An observation holds a robot's whole state, but for three things:

- Its position along the ground, on which the motion does not depend; it restarts at 0.
- Velocities beyond ±10 of Hopper and Walker2d, which Gymnasium clips in the observation: from there on a restarted
  robot moves differently. Such starts are left out wherever a restart is to say what is true.
- The part of Ant's reward that stems from where MuJoCo last evaluated the torso, within the step before: rewards of
  restarted Ants differ from recorded ones, in trajectories of ours by up to 0.07.

The solver starts cold rather than from the last accelerations, as it would in an unbroken episode; it converges to the
same motion (below 1e-7 from float64 observations; contacts turn the rounding of float32 ones into up to 4e-3).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import EXPLODED, THRESHOLDS, Steps
from envtf_lit.robots.tasks import ROBOTS, Robot, quiet_mujoco
from envtf_lit.world_models.forecast import Scale, Trajectories, nmse

# after these MuJoCo goes on from its initial state
GIVEN_UP = [int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{kind}")) for kind in ("POS", "VEL", "ACC")]  # pyright: ignore


class Physics:
    """A robot's simulator that can be put into any state.

    Args:
        robot: of the twenty tasks, or a variant; beyond the robot's own observation (Ant's contact forces) nothing of
            what a restart is given is used.

    Raises:
        UserError: the robot's body is another in each episode, which no observation tells.
    """

    def __init__(self, robot: Robot) -> None:
        if robot.hidden_dynamics:
            raise UserError(
                f"{robot.name}{robot.variant} has another body in each episode, which its observations do not tell: "
                "give the robot without its variant."
            )
        self.robot = robot
        self._env: Any = robot.make().unwrapped
        self._hidden = self._env.model.nq + self._env.model.nv - ROBOTS[robot.name].observation_dim  # leading qpos

    def step(self, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Restarts at each observation and takes one action there; rows do not influence each other.

        Args:
            observations: (B, S), any floating type.
            actions: (B, A), within the robot's limits.

        Returns:
            Next observations (B, S) float64, rewards (B,) float64, terminated (B,) bool. Where an observation is not
            finite, or so extreme that MuJoCo gives up, observation and reward are NaN and terminated is True.

        Raises:
            UserError: the columns have other widths than the robot's.
        """
        self._check(observations, actions)
        outcomes = np.empty((len(observations), self.robot.observation_dim + 1))
        terminated = np.empty(len(observations), bool)
        with quiet_mujoco():
            for row, (observation, action) in enumerate(zip(observations, actions, strict=True)):
                self._restart(observation)
                outcomes[row], terminated[row] = self._act(action)
        return outcomes[:, :-1], outcomes[:, -1], terminated

    def replay(self, trajectories: Trajectories, starts: np.ndarray, scale: Scale, *, beyond: float) -> Tensor:
        """The recorded actions from other starts, each in one unbroken run of the simulator.

        Args:
            trajectories: B of up to T steps, on any device; they go on past a fall if the record does.
            starts: (B, S) observations to start from.
            scale: the units of the nmse.
            beyond: a replay ends where its nmse passes this; what follows counts as infinitely wrong.

        Returns:
            (B, T, S + 1) next observations and, last, rewards, as `Forecast.mean` has them; infinite beyond the end.
        """
        self._check(starts, trajectories.actions[:, 0])
        outcomes = torch.full(trajectories.targets.shape, torch.inf)
        live = scale.live.cpu().numpy()
        std = scale.std.double().cpu().numpy()[live]
        recorded = zip(starts, *(x.cpu().numpy() for x in (trajectories.actions, trajectories.targets)), strict=True)
        with quiet_mujoco():
            for row, (start, actions, targets) in enumerate(recorded):
                self._restart(start)
                for t in range(int(trajectories.lengths[row])):
                    outcome, _ = self._act(actions[t])
                    outcomes[row, t] = torch.from_numpy(outcome)
                    if not np.square((outcome - targets[t])[live] / std).mean() <= beyond:  # not: NaN ends it, too
                        break
        return outcomes

    def depth(self, observations: np.ndarray) -> np.ndarray:
        """(B,) float64, how many metres of the body stand in the ground, at most; 0 where none does.

        Contacts are soft, so that real robots sink in by millimetres or centimetres. An imagined state may be far
        below, where a restart throws the robot out: no real motion begins there.
        """
        depths, ground = np.zeros(len(observations)), self._env.model.geom_bodyid == 0  # what belongs to the world
        with quiet_mujoco():
            for row, observation in enumerate(observations):
                self._restart(observation)
                contact = self._env.data.contact
                depths[row] = -contact.dist[ground[contact.geom].any(1)].min(initial=0.0)
        return depths

    def _check(self, observations: Any, actions: Any) -> None:
        found, expected = (observations.shape[1], actions.shape[1]), (self.robot.observation_dim, self.robot.action_dim)
        if found != expected:
            raise UserError(
                f"Observations and actions of {self.robot.env_id} have {expected[0]} and {expected[1]} columns, and "
                f"these have {found[0]} and {found[1]}: give what was recorded of this robot."
            )

    def _restart(self, observation: np.ndarray) -> None:
        """Puts the simulator into the state (S,), without anything left of what it did before."""
        model, data = self._env.model, self._env.data
        mujoco.mj_resetData(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        positions = np.zeros(model.nq)
        seen = model.nq - self._hidden
        positions[self._hidden :] = observation[:seen]
        if self.robot.name == "ant":  # an imagined orientation need not be a unit quaternion
            positions[3:7] /= max(float(np.linalg.norm(positions[3:7])), 1e-12)
        self._env.set_state(positions, np.asarray(observation[seen : seen + model.nv], float))

    def _act(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """The outcome (S + 1,) of one action (A,), and whether the robot fell."""
        observation, reward, terminated, _, _ = self._env.step(action)
        if any(self._env.data.warning[kind].number for kind in GIVEN_UP):
            return np.full(len(observation) + 1, np.nan), True
        return np.append(observation, reward), bool(terminated)


def perturbed(trajectories: Trajectories, scale: Scale, size: float, *, seed: int) -> np.ndarray:
    """(B, S) first observations, off by Gaussian noise of `size` standard deviations in each live dimension."""
    first = trajectories.observations[:, 0].double().cpu().numpy()
    noise = np.random.default_rng(seed).normal(size=first.shape)
    return first + size * noise * np.where(scale.live.cpu().numpy(), scale.std.double().cpu().numpy(), 0.0)[:-1]


@dataclass(frozen=True, eq=False)
class Ceiling:
    """Upper bound of any model's length: how long real physics stays near the record when its start is slightly off.

    One disturbance, at the start, is all there is; a model errs at every step. So this bounds from above.

    Attributes:
        size: of the disturbance, in standard deviations of each live dimension.
        steps: by threshold.
        trajectories: B that were replayed.
        outcomes: (B, T, S + 1) what happened instead, infinite once a replay has exploded.
        error: (B, T) its nmse.
    """

    size: float
    steps: dict[float, Steps]
    trajectories: Trajectories
    outcomes: Tensor
    error: Tensor


def ceiling(
    physics: Physics,
    trajectories: Trajectories,
    scale: Scale,
    size: float,
    *,
    seed: int,
    thresholds: Sequence[float] = THRESHOLDS,
) -> Ceiling:
    """Replays the recorded actions in MuJoCo from first states that are off by `size`.

    Args:
        physics: of the robot that was recorded.
        trajectories: recorded; those whose first state has a clipped velocity are left out, for no replay of theirs
            would begin as the record did.
        scale: the units of the disturbance and of the nmse.
        size: such as a model's own one-step error, the root of its mean one-step nmse.
        seed: of the disturbance's direction.
        thresholds: of the nmse.

    Raises:
        UserError: every trajectory begins with a clipped velocity.
    """
    trajectories = trajectories.select(~physics.robot.clipped(trajectories.observations[:, 0]))
    if len(trajectories.lengths) == 0:
        raise UserError(
            f"Every trajectory of {physics.robot.name} begins with a velocity that its observation clips: take more of "
            "them, or let them start earlier."
        )
    starts = perturbed(trajectories, scale, size, seed=seed)
    outcomes = physics.replay(trajectories, starts, scale, beyond=EXPLODED).to(trajectories.targets.device)
    error = nmse(outcomes, trajectories, scale)
    steps = {threshold: Steps.within(error, trajectories.lengths, threshold) for threshold in thresholds}
    return Ceiling(size, steps, trajectories, outcomes, error)
