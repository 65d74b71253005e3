"""Reading and writing of Minari datasets (https://minari.farama.org).

Nothing in a Minari folder is run: the environment that its metadata name is made by `recover_environment()` alone, when
its user asks for it, never here.
"""

import contextlib
import copy
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import h5py
import numpy as np

from envtf_lit.data.checks import build_dataset
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.fetch import fingerprint
from envtf_lit.data.sources.files import hdf5_bytes, own_hdf5
from envtf_lit.data.sources.raw import Raw, check_size
from envtf_lit.errors import UserError
from envtf_lit.files import replacing
from envtf_lit.robots.hidden_dynamics import HiddenDynamics
from envtf_lit.robots.tasks import get_task

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset

HDF5_FILE = "main_data.hdf5"  # the whole of a Minari dataset in the format `hdf5`, its default
MINARI = "minari:"  # before an id, where a file could stand
TASK = "envtf_lit_task"  # our key in Minari's metadata
FACTS = ("total_episodes", "total_steps", "minari_version", "algorithm_name", "author", "code_permalink")


def read_minari(id_or_path: str | Path, *, task: str | None = None, download: bool = False) -> OfflineDataset:
    """Reads and checks a Minari dataset.

    Minari keeps T+1 observations an episode, so that next observations are known to the last row. An episode that ends
    without a flag is marked truncated. The action space is the dataset's own.

    Args:
        id_or_path: such as `mujoco/hopper/medium-v0`, below `MINARI_DATASETS_PATH` or `~/.minari/datasets`; or the
            dataset's folder.
        task: such as `hopper-medium`; None takes the name that `write_minari` left, where there is one.
        download: fetches a dataset that is not there from Minari's remote (`MINARI_REMOTE`, else Farama's).

    Raises:
        UserError: there is no such dataset or it cannot be fetched, its observations or actions are not plain vectors,
            or it is damaged or does not fit the task.
    """
    raw = minari_raw(id_or_path, download)
    return build_dataset(raw.columns, raw.attributes, task=task, source=f"The Minari dataset {id_or_path}")


def minari_raw(id_or_path: str | Path, download: bool) -> Raw:
    """What a Minari dataset holds, as it lies there; arguments and errors are those of `read_minari`."""
    folder = _find(id_or_path, download)
    source = f"The Minari dataset {id_or_path}"
    with _explained(source):
        dataset = _open(folder, source)
        _check_spaces(dataset, source)
        attributes = {"action_low": dataset.action_space.low, "action_high": dataset.action_space.high}
        attributes["task"] = dataset.storage.metadata.get(TASK)
        return Raw(_columns(dataset, source), attributes)


def describe_minari(id_or_path: str | Path) -> dict[str, Any]:
    """What the metadata of a dataset on this machine say of it, with its file's size and sha256, ready for JSON.

    Raises:
        UserError: there is no such dataset, or it is damaged.
    """
    folder = _find(id_or_path, download=False)
    with _explained(f"The Minari dataset {id_or_path}"):
        metadata = _metadata(folder)
        environment = json.loads(metadata["env_spec"])["id"] if "env_spec" in metadata else None
    facts = {"minari_id": metadata.get("dataset_id"), "collected_in": environment, "path": str(folder)}
    facts |= {name: metadata[name] for name in FACTS if name in metadata}
    if (file := folder / HDF5_FILE).is_file():
        facts |= fingerprint(file)
    return facts


def write_minari(dataset: OfflineDataset, dataset_id: str, *, root: str | Path | None = None) -> int:
    """Writes a dataset that `minari.load_dataset` reads; equal columns come back from `read_minari`.

    Minari keeps one observation between two steps of an episode. Where a next observation differs from the following
    row, the episode is split there, and the part before it marked truncated. `recover_environment()` makes the task's
    environment; without a task there is none to make, and the description says so.

    Args:
        dataset: at least one episode.
        dataset_id: `name-v0` or `namespace/name-v0`.
        root: the folder of all Minari datasets; None takes `MINARI_DATASETS_PATH`, else `~/.minari/datasets`.

    Returns:
        How many times an episode was split.

    Raises:
        UserError: the id is malformed or taken, or the disk is full. Nothing half-written stays.
    """
    from minari import __version__
    from minari.dataset.minari_storage import MinariStorage

    folder = _place(dataset_id, root)
    if folder.exists():
        raise UserError(f"{folder} exists: give the Minari dataset another name or version, or delete that folder.")
    starts = _piece_starts(dataset)
    metadata = {"dataset_id": dataset_id, "minari_version": __version__, "description": _description(dataset)}
    with replacing(folder) as temporary:
        temporary.mkdir()
        storage = MinariStorage.new(
            temporary / "data",
            observation_space=gym.spaces.Box(-np.inf, np.inf, (dataset.observation_dim,), np.float32),
            action_space=gym.spaces.Box(dataset.action_low, dataset.action_high, dtype=np.float32),
            env_spec=_environment(dataset),
        )
        storage.update_metadata(metadata if dataset.task is None else metadata | {TASK: dataset.task})
        storage.update_episodes(_buffers(dataset, starts))
    return len(starts) - len(dataset.episode_starts)


# reading


def _find(id_or_path: str | Path, download: bool) -> Path:
    """The folder with `metadata.json`."""
    given = Path(id_or_path)
    if given.is_dir():
        folder = given / "data" if (given / "data").is_dir() else given
        if not (folder / "metadata.json").is_file():
            raise UserError(f"{given} is a folder and holds no Minari dataset: name a dataset's folder, or a file.")
        return folder
    if given.is_absolute():
        raise UserError(f"{given} is not a folder: give the folder of a Minari dataset, or its id.")
    folder = _place(str(id_or_path), None) / "data"
    if download and not _is_whole(folder):
        _download(str(id_or_path), folder)
    if not folder.is_dir():
        raise UserError(
            f"There is no Minari dataset {id_or_path} in {folder.parent}: fetch it with `minari download "
            f"{id_or_path}`, or set MINARI_DATASETS_PATH to the folder that holds it."
        )
    return folder


def _place(dataset_id: str, root: str | Path | None) -> Path:
    from minari.dataset.minari_dataset import DATASET_ID_RE
    from minari.storage.datasets_root_dir import get_dataset_path

    match = DATASET_ID_RE.fullmatch(dataset_id)
    if match is None or match.group("version") is None:
        raise UserError(f"{dataset_id!r} is not a Minari id: write name-v0 or namespace/name-v0.")
    return get_dataset_path(dataset_id) if root is None else Path(root) / dataset_id


def _is_whole(folder: Path) -> bool:
    """False for what a broken download leaves: metadata come first, the file with the data may be missing."""
    return (folder / "metadata.json").is_file() and sum(1 for _ in folder.iterdir()) > 1


def _download(dataset_id: str, folder: Path) -> None:
    import minari

    try:
        with contextlib.redirect_stdout(sys.stderr):  # minari prints, and a stage's output is JSON
            minari.download_dataset(dataset_id, force_download=folder.exists())
    except Exception as error:  # whatever the network and the remote's own library raise
        raise UserError(
            f"Cannot fetch the Minari dataset {dataset_id} ({_line(error)}): try again later, or fetch it on another "
            f"machine with `minari download {dataset_id}` and copy its folder to {folder.parent}."
        ) from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextlib.contextmanager
def _explained(source: str) -> Iterator[None]:
    """What minari and h5py raise for a folder that is damaged, as one sentence."""
    try:
        yield
    except UserError:
        raise
    except BlockingIOError:
        raise UserError(f"{source} is open for writing in another program: close it there.") from None
    except ImportError as error:
        raise UserError(f"{source} needs a package that is missing ({error}).") from None
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        AssertionError,
        RuntimeError,
        MemoryError,
    ) as error:
        raise UserError(f"{source} is damaged or too new or old ({_line(error)}): fetch or write it anew.") from None


def _metadata(folder: Path) -> dict[str, Any]:
    from minari.dataset.minari_storage import MinariStorage

    metadata = MinariStorage.read_raw_metadata(folder)
    if not isinstance(metadata, dict):
        raise ValueError("metadata.json holds no names")
    return metadata


def _open(folder: Path, source: str) -> "MinariDataset":
    from minari import MinariDataset

    metadata = _metadata(folder)
    if "observation_space" not in metadata or "action_space" not in metadata:
        # minari would import the code that the metadata name, to ask it for its spaces
        raise UserError(f"{source} does not say its spaces: write it anew with Minari 0.5 or newer.")
    if metadata.get("data_format") == "hdf5":
        there = _check_file(folder / HDF5_FILE, source)
    else:
        there = sum(1 for entry in folder.iterdir() if entry.is_dir())
    told = metadata.get("total_episodes")  # as many are laid out by Minari, before it looks for them
    if type(told) is not int or not 0 <= told <= there:
        raise UserError(f"{source} says that it has {told!s:.40} episodes and holds {there}: fetch or write it anew.")
    return MinariDataset(folder)


def _check_file(path: Path, source: str) -> int:
    """The number of episodes; nothing may lead to another file or to the same place again, nor be larger than it."""
    declared, seen = {}, set[Any]()

    def visit(group: h5py.Group) -> None:
        for name in map(str, group):
            item = own_hdf5(group, name)
            if item is None or item in seen:
                where = f"{group.name}/{name}".replace("//", "/")
                raise UserError(
                    f"{source} holds under {where} what leads elsewhere: store plain arrays, without links."
                )
            seen.add(item)
            if isinstance(item, h5py.Group):
                visit(item)
            else:
                declared[f"{group.name}/{name}"] = hdf5_bytes(item)

    with h5py.File(path, "r") as file:
        seen.add(file["/"])
        visit(file)
        episodes = len(file)
    check_size(path, declared)
    return episodes


def _check_spaces(dataset: "MinariDataset", source: str) -> None:
    for kind, space in (("observations", dataset.observation_space), ("actions", dataset.action_space)):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise UserError(
                f"{source} has {kind} in {space!s:.200}: this package reads vectors (a Box of one dimension); flatten "
                "them, for instance with gymnasium.wrappers.FlattenObservation, and write the dataset anew."
            )
    if not dataset.action_space.is_bounded():
        raise UserError(f"{source} has actions in the unbounded {dataset.action_space}: rescale them to limits.")


def _columns(dataset: "MinariDataset", source: str) -> dict[str, np.ndarray]:
    episodes = [_episode(data, source) for data in dataset.iterate_episodes()]
    if not episodes:
        raise UserError(f"{source} has no episodes: collect some.")
    return {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}


def _episode(data: "EpisodeData", source: str) -> dict[str, np.ndarray]:
    """The columns of one episode; observations and their successors share memory."""
    steps = len(data.rewards)
    observations, actions = np.asarray(data.observations), np.asarray(data.actions)
    if steps == 0 or len(observations) != steps + 1 or len(actions) != steps:
        raise UserError(
            f"{source}: episode {data.id} has {len(observations)} observations, {len(actions)} actions and {steps} "
            "rewards: T steps need T+1 observations."
        )
    terminated, truncated = np.array(data.terminations, bool), np.array(data.truncations, bool)
    truncated[-1] |= not terminated[-1]
    return {
        "observations": observations[:-1],
        "actions": actions,
        "rewards": np.asarray(data.rewards),
        "next_observations": observations[1:],
        "terminated": terminated,
        "truncated": truncated,
    }


# writing


def _piece_starts(dataset: OfflineDataset) -> np.ndarray:
    """Episode starts, and every row whose observation is not the next observation of the row before it."""
    follows = (dataset.next_observations[:-1] == dataset.observations[1:]).all(axis=1)
    starts = np.append(True, ~follows)
    starts[dataset.episode_starts] = True
    return np.flatnonzero(starts)


def _buffers(dataset: OfflineDataset, starts: np.ndarray) -> Iterator[Any]:
    from minari.data_collector.episode_buffer import EpisodeBuffer

    for start, end in zip(starts, np.append(starts[1:], len(dataset)), strict=True):
        rows = slice(start, end)
        truncated = dataset.truncated[rows].copy()
        truncated[-1] |= not dataset.terminated[end - 1]
        columns: dict[str, Any] = {  # arrays, where minari's annotations know lists alone
            "observations": np.concatenate([dataset.observations[rows], dataset.next_observations[end - 1 : end]]),
            "actions": dataset.actions[rows],
            "rewards": dataset.rewards[rows],
            "terminations": dataset.terminated[rows],
            "truncations": truncated,
        }
        yield EpisodeBuffer(**columns)


def _environment(dataset: OfflineDataset) -> Any:
    if dataset.task is None:
        return None
    robot = get_task(dataset.task).robot
    spec = copy.deepcopy(gym.spec(robot.env_id))
    spec.kwargs = spec.kwargs | robot.env_kwargs
    if robot.hidden_dynamics:
        spec.additional_wrappers = (HiddenDynamics.wrapper_spec(),)
    return spec


def _description(dataset: OfflineDataset) -> str:
    if dataset.task is None:
        return "Written by envtf_lit. No environment is known, so that recover_environment() has none to make."
    env_id = get_task(dataset.task).robot.env_id
    return f"{dataset.task}, written by envtf_lit; recover_environment() makes {env_id}."
