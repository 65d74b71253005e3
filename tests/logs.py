"""A small log as a user might have it, all noise: columns, and files of them."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from envtf_lit.data.dataset import COLUMNS, OfflineDataset

COMPRESSION: dict[str, Any] = {"chunks": True, "compression": "gzip", "shuffle": True}
KEYS = ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
Columns = dict[str, Any]


def columns(observation_dim: int = 11, action_dim: int = 3) -> Columns:
    """Three episodes of 4, 3 and 5 rows: terminated, timed out, cut by the end of the log."""
    rng = np.random.default_rng(0)
    rows = 12
    flags = np.zeros((2, rows), bool)
    flags[0, 3] = flags[1, 6] = True
    observations, actions = rng.normal(size=(rows, observation_dim)), rng.uniform(-1, 1, (rows, action_dim))
    actions[8], actions[9] = -1, 1  # so that they fill their space
    return {
        "observations": observations.astype(np.float32),
        "actions": actions.astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "next_observations": rng.normal(size=(rows, observation_dim)).astype(np.float32),
        "terminals": flags[0],
        "timeouts": flags[1],
    }


def write(path: Path, content: Columns, *, compressed: bool = False) -> Path:
    """The content as HDF5 or NPZ, by the path's ending."""
    if path.suffix == ".npz":
        (np.savez_compressed if compressed else np.savez)(path, allow_pickle=True, **content)
        return path
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            if name in ("task", "action_low", "action_high"):
                file.attrs[name] = value
            else:
                chunked = compressed and np.ndim(value) > 0 and np.size(value) > 0
                file.create_dataset(name, data=value, **(COMPRESSION if chunked else {}))
    return path


def assert_equal(first: OfflineDataset, second: OfflineDataset) -> None:
    for name in (*COLUMNS, "episode_starts", "action_low", "action_high"):
        one, two = getattr(first, name), getattr(second, name)
        assert one.dtype == two.dtype, name
        assert np.array_equal(one, two), name
    assert (first.held_out is None) == (second.held_out is None)
    assert first.held_out is None or np.array_equal(first.held_out, second.held_out)
    assert first.task == second.task


def dataset_of_chains(task: str | None = None, width: int = 4, actions: int = 2) -> OfflineDataset:
    """Episodes of 3, 2 and 4 steps: terminated, truncated, and one that the log cuts."""
    rng = np.random.default_rng(0)
    lengths = (3, 2, 4)
    chains = [rng.normal(size=(length + 1, width)).astype(np.float32) for length in lengths]
    terminated, truncated = np.zeros(9, bool), np.zeros(9, bool)
    terminated[2] = truncated[4] = truncated[8] = True
    return OfflineDataset(
        observations=np.concatenate([chain[:-1] for chain in chains]),
        actions=rng.uniform(-1, 1, (9, actions)).astype(np.float32),
        rewards=rng.normal(size=9).astype(np.float32),
        next_observations=np.concatenate([chain[1:] for chain in chains]),
        terminated=terminated,
        truncated=truncated,
        episode_starts=np.array([0, 3, 5]),
        action_low=np.full(actions, -1, np.float32),
        action_high=np.full(actions, 1, np.float32),
        task=task,
    )
