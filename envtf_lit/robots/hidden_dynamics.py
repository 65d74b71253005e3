"""Robots whose body is another in each episode, unobserved: a model must infer it from history."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

LOW, HIGH = 0.5, 1.5  # of each factor


@dataclass(frozen=True)
class Factors:
    """What an episode's simulation is, in multiples of the nominal one.

    Attributes:
        friction: of all contacts.
        mass: of all links, and of their inertias with it, as if they were of another density.
        strength: torque that each actuator gives for the same action.
    """

    friction: float = 1.0
    mass: float = 1.0
    strength: float = 1.0


class HiddenDynamics(gymnasium.Wrapper, RecordConstructorArgs):
    """Draws friction, mass and actuator strength anew at each reset, each uniform in [0.5, 1.5] times nominal.

    Observations stay as they are: none of them holds the factors. The start state after `reset(seed)` is the nominal
    robot's; the factors come next from the same stream, the environment's own `np_random`.

    Attributes:
        factors: those of the present episode; nominal before the first reset.

    Args:
        env: a MuJoCo environment of Gymnasium.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        import mujoco  # late, as in `Robot.make`: importing it costs, and fails where MUJOCO_GL names what is missing

        RecordConstructorArgs.__init__(self)  # so that Minari recovers this environment, not the nominal one
        gymnasium.Wrapper.__init__(self, env)
        self.factors = Factors()
        model = self._model
        self._nominal = {
            "geom_friction": model.geom_friction.copy(),
            "body_mass": model.body_mass.copy(),
            "body_inertia": model.body_inertia.copy(),
            "actuator_gear": model.actuator_gear.copy(),
        }
        self._scratch = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def _model(self) -> Any:
        return self.unwrapped.model  # pyright: ignore[reportAttributeAccessIssue]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """See `gymnasium.Env.reset`; the new factors are in `factors`, and in no observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.apply(Factors(*self.np_random.uniform(LOW, HIGH, size=3).tolist()))
        return observation, info

    def apply(self, factors: Factors) -> None:
        """Makes the simulation this multiple of the nominal one, from the present state on."""
        import mujoco

        self.factors = factors
        scales = (factors.friction, factors.mass, factors.mass, factors.strength)
        for (name, values), scale in zip(self._nominal.items(), scales, strict=True):
            getattr(self._model, name)[:] = values * scale
        mujoco.mj_setConst(self._model, self._scratch)  # pyright: ignore[reportAttributeAccessIssue]
        mujoco.mj_forward(self._model, self.unwrapped.data)  # pyright: ignore[reportAttributeAccessIssue]
