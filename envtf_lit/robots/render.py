"""Draws a robot in given poses; meant to run as a child process, since MUJOCO_GL must be set before MuJoCo is imported.

    python -m envtf_lit.robots.render poses.npz frames.npz

With MUJOCO_GL set to `egl` or `osmesa` MuJoCo renders; with `disabled` the links are drawn as lines.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco is a compiled module without type stubs)

import os
import sys

import mujoco
import numpy as np
from PIL import Image, ImageDraw

VIEW = 2.6  # metres across the drawn picture
RIM, GHOST = (60, 60, 60), (122, 172, 214)  # colours of limbs' edges, and of a ghost as a whole
SHARPNESS = 3  # drawn larger by this factor, then shrunk, for smooth edges


def render(model: mujoco.MjModel, positions: np.ndarray, size: int) -> np.ndarray:
    """Poses (F, Q) to frames (F, size, size, 3) uint8, through MuJoCo's renderer."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    camera.trackbodyid, camera.distance, camera.elevation, camera.azimuth = 1, 3.2, -12.0, 90.0
    frames, data = [], mujoco.MjData(model)
    with mujoco.Renderer(model, size, size) as renderer:
        for pose in positions:
            data.qpos[:] = pose
            mujoco.mj_kinematics(model, data)  # no dynamics: an imagined pose may be impossible
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera)
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                renderer.scene.flags[flag] = 0  # half the time of software rendering
            frames.append(renderer.render())
    return np.stack(frames)


def draw(model: mujoco.MjModel, positions: np.ndarray, size: int) -> np.ndarray:
    """Poses (F, Q) to frames (F, size, size, 3) uint8: capsules and spheres seen from the side, without any GL."""
    data = mujoco.MjData(model)
    frames = []
    for pose in positions:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        frames.append(_side_view(model, data, size))
    return np.stack(frames)


def draw_with_ghost(model: mujoco.MjModel, positions: np.ndarray, ghosts: np.ndarray, size: int) -> np.ndarray:
    """As `draw`, each pose (F, Q) in front of another one (F, Q) in a single pale colour, which no camera follows."""
    data, ghost = mujoco.MjData(model), mujoco.MjData(model)
    frames = []
    for pose, other in zip(positions, ghosts, strict=True):
        data.qpos[:], ghost.qpos[:] = pose, other
        mujoco.mj_kinematics(model, data)
        mujoco.mj_kinematics(model, ghost)
        frames.append(_side_view(model, data, size, ghost))
    return np.stack(frames)


def _side_view(model: mujoco.MjModel, data: mujoco.MjData, size: int, ghost: mujoco.MjData | None = None) -> np.ndarray:
    scale = SHARPNESS * size / VIEW
    image = Image.new("RGB", (SHARPNESS * size, SHARPNESS * size), (236, 240, 245))
    pen = ImageDraw.Draw(image)
    left, ground = data.xpos[1, 0] - VIEW / 2, 0.85 * image.height

    def pixel(point: np.ndarray) -> tuple[float, float]:
        return (point[0] - left) * scale, ground - point[2] * scale

    def robot(data: mujoco.MjData, only: tuple[int, ...] | None = None) -> None:
        for i in np.argsort(-data.geom_xpos[:, 1], kind="stable"):  # what is farther away first
            if model.geom_bodyid[i] != 0 and int(model.geom_type[i]) in rounded:
                half = data.geom_xmat[i].reshape(3, 3)[:, 2] * model.geom_size[i, 1]  # (3,) centre to cap
                ends = pixel(data.geom_xpos[i] - half), pixel(data.geom_xpos[i] + half)
                colour = only or tuple(int(255 * c) for c in model.geom_rgba[i, :3])
                _capsule(pen, *ends, model.geom_size[i, 0] * scale, colour, rim=only or RIM)

    pen.rectangle((0, ground, image.width, image.height), fill=(205, 212, 220))
    for metre in range(int(np.floor(left)), int(np.ceil(left + VIEW)) + 1):  # marks that show the robot's progress
        mark = (metre - left) * scale
        pen.line((mark, ground, mark, image.height), fill=(160, 168, 178), width=SHARPNESS)
    rounded = {int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_SPHERE)}
    if ghost is not None:
        robot(ghost, GHOST)
    robot(data)
    return np.asarray(image.resize((size, size), Image.Resampling.BOX))


def _capsule(pen: ImageDraw.ImageDraw, start: tuple, end: tuple, radius: float, colour: tuple, *, rim: tuple) -> None:
    for grow, fill in ((SHARPNESS, rim), (0, colour)):  # a rim, then the body
        pen.line((*start, *end), fill=fill, width=round(2 * (radius + grow)))
        for x, y in (start, end):
            r = radius + grow
            pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)


def main(source: str, target: str) -> None:
    """Reads `model` (path of an MJCF file), `positions` (F, Q) and `size`, writes `frames` (F, size, size, 3)."""
    with np.load(source, allow_pickle=False) as given:
        path, positions, size = str(given["model"]), given["positions"], int(given["size"])
    model = mujoco.MjModel.from_xml_path(path)
    paint = draw if os.environ.get("MUJOCO_GL") == "disabled" else render
    np.savez_compressed(target, frames=paint(model, positions, size))


if __name__ == "__main__":
    main(*sys.argv[1:])
