"""Policies on disk, with what is known of their training."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envtf_lit.actors import Actor
from envtf_lit.files import replacing, write_table
from envtf_lit.policy import save_policy
from envtf_lit.training import Curves, record_training


def publish_policy(
    target: Path,
    actor: Actor,
    curves: Curves,
    kept: Mapping[str, float],
    settings: dict[str, Any],
    records: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> dict[str, Any]:
    """Writes a policy's folder.

    Args:
        target: folder of the weights, metrics, curves and resolved options.
        actor: to keep.
        curves: of the training.
        kept: the row of them that belongs to the actor.
        settings: the resolved options.
        records: further tables (`Algorithm.records`), each written as `NAME.csv`.

    Returns:
        The row, its columns named without their split.
    """
    metrics = {name.rpartition("/")[2]: value for name, value in kept.items()}
    with replacing(target) as folder:
        save_policy(folder, actor)
        record_training(folder, metrics, settings, curves)
        for name, rows in (records or {}).items():
            write_table(folder / f"{name}.csv", rows)
    return metrics
