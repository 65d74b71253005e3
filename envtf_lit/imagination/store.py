"""Imagined rollouts on disk: HDF5, equal rollouts in equal bytes."""

import io
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import torch

from envtf_lit.errors import UserError
from envtf_lit.files import replacing
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
        with h5py.File(path, "r") as file:
            return Rollouts(**{field.name: torch.as_tensor(file[field.name][()]) for field in fields(Rollouts)})  # pyright: ignore[reportIndexIssue]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} holds no imagined rollouts ({error}): run `envtf generate_rollouts`.") from None
