"""Imagined rollouts on disk: HDF5, equal rollouts in equal bytes."""

import io
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import torch

from envtf_lit.data.sources.files import hdf5_bytes, own_hdf5
from envtf_lit.data.sources.raw import check_size
from envtf_lit.errors import UserError
from envtf_lit.files import check_plain, replacing
from envtf_lit.imagination.rollouts import Rollouts


def save_rollouts(rollouts: Rollouts, path: str | Path, *, provenance: dict[str, Any]) -> None:
    """Writes all columns as HDF5, with `provenance` as a JSON attribute; equal rollouts give equal bytes."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, column in vars(rollouts).items():
            file.create_dataset(name, data=column.cpu().numpy(), track_times=False)
        file.attrs["provenance"] = json.dumps(provenance, sort_keys=True)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def load_rollouts(path: str | Path) -> Rollouts:
    """Reads what `save_rollouts` wrote.

    Raises:
        UserError: the file is missing, damaged, or lacks a column.
    """
    try:
        check_plain(path)
        with h5py.File(path, "r") as file:
            stored = {field.name: own_hdf5(file, field.name) for field in fields(Rollouts)}
            odd = next((name for name, item in stored.items() if not isinstance(item, h5py.Dataset)), None)
            if odd is not None:
                raise KeyError(f"no plain array {odd!r}")
            items = {name: item for name, item in stored.items() if isinstance(item, h5py.Dataset)}
            check_size(Path(path), {name: hdf5_bytes(item) for name, item in items.items()})
            rollouts = Rollouts(**{name: torch.as_tensor(item[()]) for name, item in items.items()})
    except UserError:
        raise
    except BlockingIOError:
        raise UserError(f"{path} is open for writing in another program: close it there.") from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise UserError(f"{path} holds no imagined rollouts ({error}): run `envtf generate_rollouts`.") from None
    _check_shapes(rollouts, path)
    return rollouts


def _check_shapes(rollouts: Rollouts, path: str | Path) -> None:
    H, B, S = rollouts.observations.shape if rollouts.observations.ndim == 3 else (0, 0, 0)
    wide = {"observations": S, "next_observations": S, "aleatoric": S + 1, "actions": rollouts.actions.shape[-1:]}
    for name, column in vars(rollouts).items():
        width = wide.get(name, ())
        expected = (H, B, *(width if isinstance(width, tuple) else (width,)))
        if column.shape != expected or 0 in expected:
            beside = tuple(rollouts.observations.shape)
            what = f"{name!r} has shape {tuple(column.shape)} beside observations of {beside}"
            raise UserError(f"{path} holds no imagined rollouts ({what}): run `envtf generate_rollouts`.")
