"""`envtf data`: looks at a dataset, and writes it in another format."""

from collections.abc import Sequence
from typing import Annotated

from envtf_lit.cli.output import console
from envtf_lit.cli.signatures import run_command

Source = Annotated[str, "IN"]
Target = Annotated[str, "OUT"]


def check(source: Source, /, *, task: str | None = None) -> None:
    """Prints what a dataset holds; exits with status 2 where it cannot be used.

    Args:
        source: HDF5, NPZ, Parquet or CSV file, minari:ID, or the folder of a Minari or LeRobot dataset.
        task: robot and tier that the data came from, such as hopper-medium.
    """
    from envtf_lit.data.check_report import inspect_source, render

    inspection = inspect_source(source, task=task)
    console().print(render(inspection))
    if not inspection.usable:
        raise SystemExit(2)


def convert(
    source: Source,
    target: Target,
    /,
    *,
    task: str | None = None,
    action_low: tuple[float, ...] | None = None,
    action_high: tuple[float, ...] | None = None,
) -> None:
    """Writes a dataset in another format.

    Args:
        source: HDF5, NPZ, Parquet or CSV file, minari:ID, or the folder of a Minari or LeRobot dataset.
        target: a new file ending in .h5, .hdf5, .npz or .parquet, or minari:ID.
        task: robot and tier that the data came from, such as hopper-medium.
        action_low: low limits of the actions, one number or one for each dimension, where the file states none.
        action_high: high limits, likewise.
    """
    from envtf_lit.data import conversion

    limits = dict(action_low=action_low, action_high=action_high)
    dataset, findings = conversion.convert(source, target, task=task, **limits)
    out = console()
    out.print(f"Wrote {len(dataset):,} transitions to {target}")
    for finding in findings:
        out.print(f"{finding.kind}: {finding}")


FUNCTIONS = {"data check": check, "data convert": convert}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf data check` or `envtf data convert`."""
    run_command(FUNCTIONS[name], name, words)
