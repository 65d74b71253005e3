"""Conversion of datasets between HDF5, NPZ, Parquet and Minari, from CSV too, and what that changes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envtf_lit.data.checks import examine
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding
from envtf_lit.data.sources.files import is_hdf5, save_dataset
from envtf_lit.data.sources.local import open_source
from envtf_lit.data.sources.minari import MINARI, write_minari
from envtf_lit.data.sources.parquet import PARQUET, write_parquet
from envtf_lit.errors import UserError


def convert(
    source: str,
    target: str,
    *,
    task: str | None = None,
    action_low: Sequence[float] | None = None,
    action_high: Sequence[float] | None = None,
) -> tuple[OfflineDataset, list[Finding]]:
    """Reads a dataset and writes it as something else.

    HDF5, NPZ and Parquet hold the same columns, bit for bit. Minari keeps T+1 observations of an episode of T steps:
    where a next observation differs from the following row's, `write_minari` splits the episode.

    Args:
        source: an HDF5, NPZ, Parquet or CSV file, `minari:` and the id of a Minari dataset on this machine, or its
            folder, or that of a LeRobot dataset.
        target: a new file ending in .h5, .hdf5, .npz or .parquet, or `minari:` and a new id, such as
            `minari:my/robot-v0`.
        task: such as `hopper-medium-replay`; None takes the name in the source, where there is one.
        action_low, action_high: one number, or one for each action dimension; None takes what the source states.

    Returns:
        The dataset, and what was changed or left behind.

    Raises:
        UserError: the source cannot be used, or the target exists or cannot be written. Nothing half-written stays.
    """
    to_minari = target.startswith(MINARI)
    to_parquet = not to_minari and Path(target).suffix.lower() in PARQUET
    if not to_minari:
        if not to_parquet:
            is_hdf5(Path(target))
        if Path(target).exists():
            raise UserError(f"{target} exists already: give the new file another name, or delete this one.")
    limits = {"action_low": action_low, "action_high": action_high}
    stated = {name: np.asarray(values) for name, values in limits.items() if values is not None}
    dataset, findings = _read(source, task, stated)
    if not to_minari:
        (write_parquet if to_parquet else save_dataset)(dataset, target)
        return dataset, findings
    splits = write_minari(dataset, target.removeprefix(MINARI))
    if splits:
        what = f"{splits} episodes were split where a next observation is not the following row's: Minari keeps one"
        findings.append(Finding("note", what))
    if dataset.held_out is not None:
        what = "which episodes are held out is left behind, for Minari has no place for it"
        findings.append(Finding("note", what))
    if dataset.task is None:
        findings.append(Finding("note", "no task is named, so that recover_environment() has nothing to make"))
    return dataset, findings


def _read(source: str, task: str | None, stated: dict[str, np.ndarray]) -> tuple[OfflineDataset, list[Finding]]:
    with open_source(source) as raw:
        dataset, findings = examine(raw.columns, raw.attributes | stated, task=task, broken=raw.broken)
    findings += raw.notes
    if dataset is None:
        worst = next(finding for finding in findings if finding.kind == "error")
        raise UserError(f"{source}: {worst}; `envtf data check` lists all that is wrong.")
    if raw.ignored:
        names = ", ".join(raw.ignored[:8]) + (", …" if len(raw.ignored) > 8 else "")
        findings.append(Finding("note", f"left behind, for a dataset has no such columns: {names}"))
    return dataset, findings
