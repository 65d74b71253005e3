"""Film strips: a robot at some of its steps, side by side, one row of pictures for each way that it went."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from envtf_lit.figures.style import drawing
from envtf_lit.robots.returns import Episode
from envtf_lit.robots.silhouette import Silhouette
from envtf_lit.robots.tasks import Robot
from envtf_lit.world_models.forecast import Trajectories

SIZE = 200  # pixels of a picture


def spread_steps(last: int, pictures: int = 6) -> list[int]:
    """Up to so many steps of 0 … last, evenly apart, the first and the last among them."""
    return np.unique(np.linspace(0, last, pictures).round().astype(int)).tolist()


def film_strip(
    strips: Mapping[str, np.ndarray], robot: Robot, steps: Sequence[int], path: str | Path, *, title: str
) -> Path:
    """Draws robots from the side, as their observations have them.

    Args:
        strips: label to observations (T, S); a strip that is shorter than a step has no picture there, and neither has
            one that is not finite.
        robot: whose observations they are.
        steps: the columns.
        path: PNG to write.
        title: over all of them.
    """
    artist = Silhouette(robot)
    with drawing(path, (1.45 * len(steps) + 0.6, 1.6 * len(strips) + 0.7), len(strips), len(steps)) as (figure, axes):
        for row, (label, observations) in zip(axes, strips.items(), strict=True):
            pictures = _pictures(artist, observations, steps)
            for axis, step in zip(row, steps, strict=True):
                axis.set(xticks=[], yticks=[])
                if step in pictures:
                    axis.imshow(pictures[step])
                else:
                    axis.set(facecolor="white", aspect="equal", xlim=(0, 1), ylim=(0, 1))  # as large as a picture
                    axis.text(0.5, 0.5, "over", ha="center", va="center", transform=axis.transAxes, color="gray")
            row[0].set_ylabel(label)
        for axis, step in zip(axes[0], steps, strict=True):
            axis.set_title(f"step {step}", fontsize="medium")
        figure.suptitle(title)
    return Path(path)


def recorded_episode(trajectories: Trajectories, row: int, robot: Robot) -> Episode:
    """A recorded trajectory as an episode that can be shown; where on the plane the robot is, is integrated."""
    length = int(trajectories.lengths[row])
    targets = trajectories.targets[row, :length].cpu().numpy()
    observations = np.concatenate([trajectories.observations[row, :1].cpu().numpy(), targets[:, :-1]])
    artist = Silhouette(robot)
    positions = [artist.start(observations[0])]
    for observation in observations[1:]:
        positions.append(artist.follow(positions[-1], observation))
    actions = trajectories.actions[row, :length].cpu().numpy()
    return Episode(-1, observations, actions, targets[:, -1].astype(np.float64), np.stack(positions))


def _pictures(artist: Silhouette, observations: np.ndarray, steps: Sequence[int]) -> dict[int, np.ndarray]:
    """The pictures (SIZE, SIZE, 3) of those steps that there are; where on the plane the robot is, is integrated."""
    found, position = {}, artist.start(observations[0])
    for step, observation in enumerate(observations):
        if not np.isfinite(observation).all():
            break
        position = artist.follow(position, observation) if step > 0 else position
        if step in steps:
            found[step] = artist.picture(position, SIZE)
    return found
