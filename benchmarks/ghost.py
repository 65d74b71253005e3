"""Draws the ghost: `python benchmarks/ghost.py PROJECT docs/ghost.gif`, after `make repro` there.

A policy's episode of median return in MuJoCo and, over it, what the world model imagines of the same actions from the
same first state, open loop with mean predictions. Needs a GL that MuJoCo can render with (EGL, unless MUJOCO_GL says
otherwise).
"""

import argparse
import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported

import mujoco
import numpy as np
import torch
from PIL import Image, ImageColor, ImageDraw, ImageFont

from envtf_lit import load_dataset, load_policy, load_world_model
from envtf_lit.figures.style import COLOURS
from envtf_lit.figures.video import STRIDE, imagined_positions, write_gif
from envtf_lit.robots.returns import Episode, evaluate_policy
from envtf_lit.robots.tasks import get_task
from envtf_lit.world_models.forecast import Scale, Trajectories, forecast, nmse
from envtf_lit.world_models.interface import WorldModel

WIDTH, HEIGHT, FOOTER = 480, 300, 26  # pixels
GHOST = (*(c / 255 for c in ImageColor.getrgb(COLOURS["imagined"])), 0.45)
LOST = 0.1  # normalised squared error beyond which the imagined episode is another one


def imagine(model: WorldModel, episode: Episode, scale: Scale, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States (steps + 1, S), the first one real, and the open-loop nmse (steps + 1,) of each."""
    observations = torch.from_numpy(episode.observations[: steps + 1])
    rewards = torch.from_numpy(episode.rewards[:steps]).float()
    targets = torch.cat([observations[1:], rewards[:, None]], dim=-1)
    actions = torch.from_numpy(episode.actions[:steps])
    recorded = Trajectories(observations[None, :-1], actions[None], targets[None], torch.tensor([steps]))
    mean = forecast(model, recorded, feedback="imagined").mean
    return torch.cat([observations[:1], mean[0, :, :-1]]).numpy(), np.append(0.0, nmse(mean, recorded, scale)[0])


def frames(xml: str, real: np.ndarray, ghost: np.ndarray) -> list[Image.Image]:
    """Poses (F, Q) of both robots to pictures, the camera beside the real one."""
    model = mujoco.MjModel.from_xml_path(xml)
    datas, pictures = [mujoco.MjData(model) for _ in range(2)], []
    camera, options, perturbation = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
    camera.distance, camera.elevation, camera.azimuth = 3.4, -10.0, 90.0
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for poses in zip(real, ghost, strict=True):
            for data, pose in zip(datas, poses, strict=True):
                data.qpos[:] = pose
                mujoco.mj_kinematics(model, data)  # no dynamics: an imagined pose may be impossible
                mujoco.mj_comPos(model, data)
                mujoco.mj_camlight(model, data)
            renderer.update_scene(datas[0], camera)
            scene = renderer.scene
            first = scene.ngeom
            mujoco.mjv_addGeoms(model, datas[1], options, perturbation, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
            for geom in scene.geoms[first : scene.ngeom]:
                geom.rgba[:] = GHOST
                geom.matid = -1
            pictures.append(Image.fromarray(renderer.render()))
    return pictures


def page(picture: Image.Image, step: int, error: float, lost: bool) -> Image.Image:
    """A frame with its footer."""
    whole = Image.new("RGB", (WIDTH, HEIGHT + FOOTER), "white")
    whole.paste(picture)
    pen, font, middle = ImageDraw.Draw(whole), ImageFont.load_default(14), HEIGHT + FOOTER / 2
    pen.text((8, middle), "imagined", fill=COLOURS["imagined"], anchor="lm", font=font)
    pen.text((72, middle), "over the real one", fill="black", anchor="lm", font=font)
    note = f"step {step}    squared error {min(error, 99.0):.3f}" + (" (lost)" if lost else "")
    pen.text((WIDTH - 8, middle), note, fill=COLOURS["imagined"] if lost else "black", anchor="rm", font=font)
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("project", type=Path)
    parser.add_argument("out", type=Path, help="GIF")
    parser.add_argument("--policy", default="et_cql")
    parser.add_argument("--world-model", default="transformer")
    parser.add_argument("--episodes", type=int, default=20, help="of which the median one is shown")
    parser.add_argument("--frames", type=int, default=75, help="of two steps each")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    dataset = load_dataset(given.project / "data/dataset.h5")
    robot = get_task(str(dataset.task)).robot
    policy = load_policy(given.project / "models/policy" / given.policy)
    episode = evaluate_policy(policy, robot, episodes=given.episodes, seed=given.seed).median
    model = load_world_model(given.project / "models/world_model" / given.world_model)
    steps = min(len(episode.actions), STRIDE * (given.frames - 1))
    states, error = imagine(model, episode, Scale.of(dataset.split()[0]), steps)
    shown = np.arange(0, steps + 1, STRIDE)
    ghost = imagined_positions(robot, states, episode.positions[0])
    xml = robot.make().unwrapped.fullpath  # pyright: ignore[reportAttributeAccessIssue]
    pictures = frames(xml, episode.positions[shown], ghost[shown])
    lost = np.maximum.accumulate(error) > LOST
    write_gif([page(p, h, error[h], bool(lost[h])) for p, h in zip(pictures, shown, strict=True)], given.out)


if __name__ == "__main__":
    main()
