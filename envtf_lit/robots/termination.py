"""Termination rules: in which states each robot has fallen, as its simulator decides it.

A rule takes next observations (..., S) to bool (...). Of robots that have none here, `world_models.termination_head`
learns one from the log.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # torch takes seconds to import
    from torch import Tensor


def _all_below(observation: "Tensor", limit: float) -> "Tensor":
    return (observation.abs() < limit).all(-1)


def hopper_terminated(observation: "Tensor") -> "Tensor":
    """Hopper-v5's unhealthy test: height <= 0.7, |pitch| >= 0.2, or any later coordinate beyond 100 in size.

    The copies of this rule in MOPO, RAMBO and their descendants apply the size test to a boolean, so that values
    below -100 pass; here it is applied to the coordinates, as the simulator does.
    """
    height, pitch = observation[..., 0], observation[..., 1]
    healthy = (height > 0.7) & (pitch.abs() < 0.2) & _all_below(observation[..., 1:], 100.0)
    return ~healthy


def walker2d_terminated(observation: "Tensor") -> "Tensor":
    """Walker2d-v5's unhealthy test: height outside (0.8, 2.0) or |pitch| >= 1."""
    height, pitch = observation[..., 0], observation[..., 1]
    return ~((height > 0.8) & (height < 2.0) & (pitch.abs() < 1.0))


def ant_terminated(observation: "Tensor") -> "Tensor":
    """Ant-v5's unhealthy test: a non-finite state or a torso height outside [0.2, 1.0]."""
    height = observation[..., 0]
    return ~(observation.isfinite().all(-1) & (height >= 0.2) & (height <= 1.0))


def never_terminated(observation: "Tensor") -> "Tensor":
    """HalfCheetah-v5 has no unhealthy state, and of a robot that is none of ours no rule is known."""
    return observation.new_zeros(observation.shape[:-1]).bool()
