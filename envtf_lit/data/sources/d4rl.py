"""D4RL's MuJoCo datasets, version 2 (Fu et al. 2020): fetched or read from a copy, with their traps mended.

D4RL's own package is not needed. Sizes and sums of the files are those that TensorFlow Datasets publishes in
`tensorflow_datasets/d4rl/*/checksums.tsv`.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from envtf_lit.data.checks import build_dataset
from envtf_lit.data.columns import blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.fetch import RemoteFile, fetch, fingerprint
from envtf_lit.data.sources.files import open_raw
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import VELOCITY_LIMIT, Robot, Task

# the second is a copy by others; the sums make it as good as the first
SERVERS = (
    "https://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2",
    "https://huggingface.co/datasets/imone/D4RL/resolve/main",
)
FILES = {  # bytes and sha256
    "hopper-random": (152525345, "63103ef7059db4c0819bd054f4e83ff339030b50bcdb46bdbe50385f234b5054"),
    "hopper-medium": (152756557, "5bdf1bc4a713c82941de44633df669b36c89850b652a25985166796d25cf71a0"),
    "hopper-medium-replay": (75854457, "e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b"),
    "hopper-medium-expert": (304537315, "9d51ad87f8c905be3880d84c6140bcdb7fbf39a19e046a237f238ba34fec9e26"),
    "hopper-full-replay": (187998921, "56baf95963c51c1e964049a974566c50ba80f289390565523e60c0ba83e0982e"),
    "halfcheetah-random": (237338037, "25407aef85b5d16c0f36b4149341edb4acc6a9e88c1db529b2de19e7464874ba"),
    "halfcheetah-medium": (237727262, "41324e8487a9556d8cfa4538827f8937f4d63dae3030825ebc9f3a726ed08ca0"),
    "halfcheetah-medium-replay": (59448533, "48d494a4770c11f48260736dec090b78bdca8375647ed4d24bfa5b6610c7f683"),
    "halfcheetah-medium-expert": (474567252, "015db75dae5bbe8e94029b71fa0bafc2073365df0c94744e71031189f3f79c06"),
    "halfcheetah-full-replay": (291381762, "27fdf7ea86e5a2cbd24d611ae9e703c86ec2e8e52823abc69dd9af6afb3a36c0"),
    "walker2d-random": (216109364, "4e863bb6090cf4a461548bd470564b32f1ae5b32ef3085f816b2ede7f092e7fa"),
    "walker2d-medium": (232254996, "cf00f43add04c17fdfc2958dd581dea0851b2e5bedbe6fda073758a8f841aeda"),
    "walker2d-medium-replay": (86323963, "e75de96a4f77acf7d4e0d6fdf0d7ccb177c26c44bb4388e4fd99f543ccfa18db"),
    "walker2d-medium-expert": (462197079, "6b8d7f868c45bbaedf460be797fb7271b46dee6ebe45fe7a64319f2005b59a04"),
    "walker2d-full-replay": (285115514, "f2720f9d27b2acef6ec9a7d9ad3b80b6c2078ad4467cee668a81e3b3c80bcf2a"),
    "ant-random": (384466831, "93cc10893eed2b8e17f81d1aa51dc23d27c5ca101a3804249f6bd038c6f06055"),
    "ant-medium": (376239825, "461c03b9f70f40d66b47608a92965e4ef3642bd9cdb1320d10acc92754167137"),
    "ant-medium-replay": (136482252, "844c4e5743ef51091f2106a3570b257fb149032c4743f8a5f02f40adc3b42a46"),
    "ant-medium-expert": (748335217, "8cfb64e62d8944b5d9dada5f0cfc13a295fafe0c6ba58b778e32ebf16c95aef1"),
    "ant-full-replay": (449390167, "b95b0a7f34b1d5d1bedfded0f8e9cfc508b59de83cd4cbfb65b18dbd5056f26c"),
}
ANT_DIMENSIONS = 111  # of which those from 27 on are contact forces that its simulator never filled: all zero
ROUNDING = 1e-4  # relative and absolute: what is farther apart is not the same observation


def load_d4rl(task: Task, path: str | Path | None, *, progress: bool = True) -> tuple[OfflineDataset, dict[str, Any]]:
    """A D4RL dataset from a copy, or from D4RL's servers.

    Downloads lie where D4RL's package keeps its own, in `D4RL_DATASET_DIR`, else `~/.d4rl/datasets`; a file that is
    there already is used.

    Args:
        task: one of the twenty, with `-v4` after its name.
        path: of a copy; None finds or downloads the file.
        progress: shows a bar.

    Returns:
        The dataset (see `read_d4rl`), and for its card: URL, path, bytes, sha256, whether the file is the published
        one, and what was mended.

    Raises:
        UserError: no server gives the file, the disk is full, the copy is missing or damaged, or it does not fit.
    """
    if task.robot.variant != "-v4":
        plain = f"{task.robot.name}-{task.tier}"
        raise UserError(
            f"The task is {task.name} and download.source is d4rl: D4RL's data are older than Gymnasium's -v5, and -v4 "
            f"is the nearest simulation to score policies in; set the task to {plain}-v4."
        )
    remote = remote_file(task)
    local = _published_copy(remote, progress) if path is None else Path(path)
    dataset, mended = read_d4rl(local, task)
    found = fingerprint(local)
    published = found == {"bytes": remote.size, "sha256": remote.sha256}
    return dataset, {
        "url": remote.urls[0], "path": str(local), **found, "published_file": published, "mended": mended
    }  # fmt: skip


def remote_file(task: Task) -> RemoteFile:
    """Where a task's file lies, and what it must be."""
    name = f"{task.robot.name}_{task.tier.replace('-', '_')}-v2.hdf5"
    return RemoteFile(tuple(f"{server}/{name}" for server in SERVERS), *FILES[f"{task.robot.name}-{task.tier}"])


def read_d4rl(path: str | Path, task: Task) -> tuple[OfflineDataset, dict[str, int]]:
    """Reads a file of D4RL's and mends what would mislead a world model.

    Next observations are those of the file, at terminals and timeouts too: `d4rl.qlearning_dataset` takes the
    following row instead, at an episode's end another's first. Where the file has none, they come from the following
    row of the same episode, whose last row is left out. An episode that stops without a flag (in the replays of a
    learner whose budget ended) is marked truncated there. Ant's constant zeros go, and velocities lie in [-10, 10]
    where the simulator shows no others.

    Args:
        path: an HDF5 file.
        task: what the file holds; only its robot must fit.

    Returns:
        The dataset, and how much was mended: `constant_dimensions` left out, `clipped_velocities`, `unmarked_ends`.

    Raises:
        UserError: the file is missing, damaged or incomplete, or it is not of that robot.
    """
    path = Path(path)
    with open_raw(path) as raw, _readable(path):
        columns, mended = dict(raw.columns), {}
        _check_ends(columns, path)
        mended["constant_dimensions"] = _drop_constants(columns, task.robot, path)
        columns = {name: _flat(name, np.asarray(values)) for name, values in columns.items()}
        mended["clipped_velocities"] = _clip_velocities(columns, task.robot)
        mended["unmarked_ends"] = _mark_ends(columns)
        return build_dataset(columns, raw.attributes, task=task.name, source=str(path), broken=raw.broken), mended


def _published_copy(remote: RemoteFile, progress: bool) -> Path:
    """Found, or downloaded."""
    name = remote.urls[0].rpartition("/")[2]
    folder = Path(os.environ.get("D4RL_DATASET_DIR") or Path.home() / ".d4rl/datasets")
    path = folder / name
    if path.is_file() and not remote.matches(path):
        raise UserError(
            f"{path} is not D4RL's file: delete it to download it again, or name it in download.path to use it all "
            "the same."
        )
    if not path.is_file():
        try:
            fetch(remote, path, progress=progress)
        except UserError as error:
            raise UserError(
                f"{error} Fetch {name} on another machine and copy it to {folder}, or name it in download.path."
            ) from error
    return path


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError) as error:  # what HDF5 raises in the middle of a file
        raise UserError(f"{path} is damaged ({' '.join(str(error).split())}): fetch it anew.") from None


def _check_ends(columns: dict[str, Any], path: Path) -> None:
    """The first version of D4RL's files tells neither where episodes end nor what followed."""
    if "truncated" not in columns and "next_observations" not in columns:
        raise UserError(f"{path} has neither 'timeouts' nor 'next_observations': take the v2 file, which has both.")
    if "truncated" not in columns:
        columns["truncated"] = np.zeros(len(columns["next_observations"]), bool)


def _drop_constants(columns: dict[str, Any], robot: Robot, path: Path) -> int:
    """Keeps Ant's positions and velocities, reading in blocks: all of it would take four times the memory."""
    live = robot.observation_dim
    for name in ("observations", "next_observations"):
        values = columns.get(name)
        if robot.name != "ant" or values is None or values.shape[1:] != (ANT_DIMENSIONS,):
            continue
        kept = np.empty((len(values), live), np.float32)
        for block in blocks(len(values), ANT_DIMENSIONS * 4):
            part = values[block]
            if part[:, live:].any():
                raise UserError(
                    f"{path}: {name!r} has contact forces in columns {live} to {ANT_DIMENSIONS - 1}, which are zero in "
                    "D4RL's Ant: set download.source to file for data of another simulator."
                )
            kept[block] = part[:, :live]
        columns[name] = kept
    return ANT_DIMENSIONS - live if isinstance(columns.get("observations"), np.ndarray) else 0


def _flat(name: str, values: np.ndarray) -> np.ndarray:
    """Some copies keep (N, 1) where (N,) is meant; flags may be 0.0 and 1.0."""
    if name in ("rewards", "terminated", "truncated") and values.ndim == 2 and values.shape[1] == 1:
        return values[:, 0]
    return values


def _clip_velocities(columns: dict[str, np.ndarray], robot: Robot) -> int:
    """-v2 and -v4 show no velocity beyond the limit; neither may a log that a policy is trained on for them."""
    clipped = 0
    for name in ("observations", "next_observations") if robot.clipped_from is not None else ():
        if name in columns and columns[name].ndim == 2:
            velocities = columns[name][:, robot.clipped_from :]
            clipped += int((np.abs(velocities) > VELOCITY_LIMIT).sum())
            np.clip(velocities, -VELOCITY_LIMIT, VELOCITY_LIMIT, out=velocities)
    return clipped


def _mark_ends(columns: dict[str, np.ndarray]) -> int:
    """Truncates where the next observation is not the following row and no flag says why."""
    here, there = columns.get("observations"), columns.get("next_observations")
    flags = [columns.get(name) for name in ("terminated", "truncated")]
    if here is None or there is None or any(flag is None for flag in flags) or here.shape != there.shape:
        return 0
    terminated, truncated = (np.asarray(flag, bool) for flag in flags)
    apart = np.zeros(len(here), bool)
    for block in blocks(len(here) - 1, here[:1].nbytes):
        apart[block] = ~np.isclose(there[block], here[1:][block], ROUNDING, ROUNDING).all(axis=1)
    unmarked = apart & ~terminated & ~truncated
    columns["truncated"] = truncated | unmarked
    return int(unmarked.sum())
