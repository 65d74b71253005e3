"""The real robot beside the imagined one, under the same actions, as a GIF."""

import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from envtf_lit.errors import UserError
from envtf_lit.figures.style import COLOURS
from envtf_lit.files import replacing
from envtf_lit.robots.render import draw_with_ghost
from envtf_lit.robots.returns import Episode
from envtf_lit.robots.tasks import ROBOTS, Robot
from envtf_lit.world_models.forecast import Scale, Trajectories, forecast, nmse
from envtf_lit.world_models.interface import WorldModel

BACKENDS = ("egl", "osmesa", "disabled")  # of MUJOCO_GL, best first; without any GL the links are drawn as lines
MOST_FRAMES = 150
STRIDE = 2  # simulated steps per frame
FRAME_MILLISECONDS = 40
SIZE, GHOST_SIZE, HEADER = 240, 360, 24  # pixels
TIMEOUT = 300.0  # seconds; a renderer that hangs counts as missing


def real_vs_imagined(
    model: WorldModel, episode: Episode, robot: Robot, scale: Scale, path: str | Path, *, frames: int = MOST_FRAMES
) -> str:
    """Writes a GIF: left what MuJoCo did, right what the model imagines of the same actions from the same first state.

    The imagination runs open loop with mean predictions and never sees a real state again.

    Args:
        model: in eval mode, on the CPU.
        episode: a real one.
        robot: whose episode it is.
        scale: the training data's units, for the error shown.
        path: GIF to write.
        frames: at most 150, of 2 steps each; fewer where the episode ends.

    Returns:
        What drew the frames: `egl`, `osmesa`, or `disabled` where no GL works and the links were drawn as lines.

    Raises:
        UserError: the number of frames is not in [1, 150].
    """
    if not 1 <= frames <= MOST_FRAMES:
        raise UserError(
            f"A video has 1 to {MOST_FRAMES} frames: {frames} were asked for; change evaluate.video_frames."
        )
    shown, real, imagined, error = _both(model, episode, robot, scale, frames)
    backend = working_backend()
    pictures = _render(robot, np.concatenate([real, imagined]), SIZE, backend)
    pairs = zip(pictures[: len(shown)], pictures[len(shown) :], shown, strict=True)
    lost = np.maximum.accumulate(error) > 0.1  # from the first passage on
    write_gif([_page(real, fake, int(h), float(error[h]), bool(lost[h])) for real, fake, h in pairs], path)
    return backend


def ghost_over_real(
    model: WorldModel, episode: Episode, robot: Robot, scale: Scale, path: str | Path, *, frames: int = MOST_FRAMES
) -> None:
    """Writes a GIF of the real robot in front of the imagined one, a pale ghost; arguments as of `real_vs_imagined`.

    Both begin in the same state and take the same actions; the picture moves with the real one. Drawn without GL.
    """
    shown, real, imagined, error = _both(model, episode, robot, scale, frames)
    pictures = draw_with_ghost(_simulator(robot).model, real, imagined, GHOST_SIZE)
    lost = np.maximum.accumulate(error) > 0.1
    captions = [_caption(int(h), float(error[h]), bool(lost[h])) for h in shown]
    write_gif([_captioned(picture, *caption) for picture, caption in zip(pictures, captions, strict=True)], path)


def _both(
    model: WorldModel, episode: Episode, robot: Robot, scale: Scale, frames: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps (F,) that are shown, real and imagined poses (F, Q) there, and the error (steps + 1,) of all steps."""
    steps = min(len(episode.actions), STRIDE * (frames - 1))
    states, error = _imagine(model, episode, scale, max(steps, 1))
    shown = np.arange(0, steps + 1, STRIDE)
    imagined = imagined_positions(robot, states, episode.positions[0])
    return shown, episode.positions[shown], imagined[shown], error


def no_video(folder: Path) -> None:
    """Says in `none.txt` why there is no GIF: the pipeline's output must hold something, and only what is true."""
    reason = "No video: this robot has no simulator here that could be shown beside the imagination.\n"
    (folder / "none.txt").write_text(reason)


def _imagine(model: WorldModel, episode: Episode, scale: Scale, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, S), the first one real, and the open-loop nmse (steps + 1,) of each."""
    observations = torch.from_numpy(episode.observations[: steps + 1])
    rewards = torch.from_numpy(episode.rewards[:steps]).float()
    targets = torch.cat([observations[1:], rewards[:, None]], dim=-1)
    actions = torch.from_numpy(episode.actions[:steps])
    recorded = Trajectories(observations[None, :-1], actions[None], targets[None], torch.tensor([len(actions)]))
    mean = forecast(model, recorded, feedback="imagined").mean
    states = torch.cat([observations[:1], mean[0, :, :-1]])
    return states.numpy(), np.append(0.0, nmse(mean, recorded, scale)[0].numpy())


def imagined_positions(robot: Robot, states: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The simulator's coordinates `qpos` (T, Q) of observations (T, S), from the real `qpos` (Q,) of the first.

    Observations leave out where on the plane the robot is: the first coordinate of our planar robots, two of Ant's.
    They are integrated from the velocities. States that are not finite repeat the last finite one.
    """
    simulator = _simulator(robot)
    hidden = len(start) + simulator.model.nv - ROBOTS[robot.name].observation_dim  # without what a variant adds
    finite = np.isfinite(states).all(1)
    states = states[np.maximum.accumulate(np.where(finite, np.arange(len(states)), 0))]
    seen = len(start) - hidden
    velocity = states[1:, seen : seen + hidden]
    plane = start[:hidden] + np.concatenate([np.zeros((1, hidden)), np.cumsum(simulator.dt * velocity, axis=0)])
    return np.concatenate([plane, states[:, :seen]], axis=1)


def _simulator(robot: Robot) -> Any:
    """Gymnasium's own environment, without wrappers: it knows the model, its file and the time of a step."""
    return robot.make().unwrapped


def _render(robot: Robot, positions: np.ndarray, size: int, backend: str) -> np.ndarray:
    """Frames (F, size, size, 3) from a child process whose MuJoCo uses this back-end."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = f"{folder}/poses.npz", f"{folder}/frames.npz"
        np.savez(source, model=_simulator(robot).fullpath, positions=positions, size=size)
        subprocess.run(
            [sys.executable, "-m", "envtf_lit.robots.render", source, target],
            env=os.environ | {"MUJOCO_GL": backend},
            cwd=folder,  # for MuJoCo's log
            check=True,
            capture_output=True,
            timeout=TIMEOUT,
        )
        with np.load(target, allow_pickle=False) as result:
            return result["frames"]


@cache
def working_backend() -> str:
    """The first of `egl`, `osmesa`, `disabled` with which a child process renders a picture that is not blank."""
    robot = ROBOTS["hopper"]
    for backend in BACKENDS[:-1]:
        try:
            picture = _render(robot, np.array([[0.0, 1.25, 0.0, 0.0, 0.0, 0.0]]), 32, backend)
        except (subprocess.SubprocessError, OSError):
            continue
        if picture.std() > 1.0:
            return backend
    return BACKENDS[-1]


def _page(real: np.ndarray, imagined: np.ndarray, step: int, error: float, lost: bool) -> Image.Image:
    height, width, _ = real.shape
    page = Image.new("RGB", (2 * width + 4, height + 2 * HEADER), "white")
    page.paste(Image.fromarray(real), (0, HEADER))
    page.paste(Image.fromarray(imagined), (width + 4, HEADER))
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(14)
    middle = {"anchor": "mm", "font": font}
    pen.text((width / 2, HEADER / 2), "real (MuJoCo)", fill="black", **middle)
    pen.text((1.5 * width + 4, HEADER / 2), "imagined (world model)", fill="black", **middle)
    note, colour = _caption(step, error, lost)
    pen.text((width + 2, height + 1.5 * HEADER), note, fill=colour, **middle)
    return page


def _caption(step: int, error: float, lost: bool) -> tuple[str, str]:
    note = f"step {step}    normalised squared error {min(error, 999):.3g}" + ("  (has passed 0.1)" if lost else "")
    return note, COLOURS["imagined"] if lost else "black"


def _captioned(picture: np.ndarray, note: str, colour: str) -> Image.Image:
    height, width, _ = picture.shape
    page = Image.new("RGB", (width, height + 2 * HEADER), "white")
    page.paste(Image.fromarray(picture), (0, HEADER))
    pen, middle = ImageDraw.Draw(page), {"anchor": "mm", "font": ImageFont.load_default(12)}
    pen.text((width / 2, HEADER / 2), "real, and as a ghost what is imagined", fill="black", **middle)
    pen.text((width / 2, height + 1.5 * HEADER), note, fill=colour, **middle)
    return page


def write_gif(pages: list[Image.Image], path: str | Path) -> None:
    """Writes an endless GIF of 25 frames per second, all frames in the palette of the middle one."""
    palette = pages[len(pages) // 2].quantize(64, dither=Image.Dither.NONE)
    indexed = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pages]
    with replacing(path) as temporary:
        indexed[0].save(
            temporary, format="GIF", save_all=True, append_images=indexed[1:], duration=FRAME_MILLISECONDS, loop=0
        )
