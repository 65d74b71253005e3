"""`envtf init`, `envtf params`, `envtf tutorial` and `envtf doctor`: what helps around the pipeline."""

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from envtf_lit.cli.output import console
from envtf_lit.cli.signatures import File, Folder, run_command
from envtf_lit.errors import UserError

Tutorial = Annotated[str, "NAME"]


def init(folder: Folder, /, *, preset: str = "small", data: File | None = None) -> None:
    """Writes a new project.

    Args:
        folder: created if missing; must not hold a dvc.yaml.
        preset: tiny, small, base or paper.
        data: an HDF5 or NPZ log of a robot of yours, that the project trains on; it is checked first, as `envtf data
            check` does, and stays where it is.
    """
    from envtf_lit.project.template import write_project

    if data is not None:
        _check(data)
    kept = write_project(folder, preset, data)
    if kept:
        console().print(f"Left as they were: {', '.join(kept)}")
    first = "" if find_spec("dvc") else "pip install 'envtf-lit[pipeline]' && "
    console().print(f"Wrote a project to {folder}. Next: {first}cd {folder} && dvc repro")


def _check(data: Path) -> None:
    """Prints what there is to say of a file; exits with status 2 where it cannot be used."""
    from envtf_lit.data.check_report import inspect_source, render
    from envtf_lit.data.sources.files import is_hdf5

    is_hdf5(data)  # of the formats that `envtf data check` reads, the pipeline reads two
    inspection = inspect_source(data)
    console().print(render(inspection))
    if not inspection.usable:
        console().print("No project was written: mend the file first.")
        raise SystemExit(2)
    if inspection.dataset is not None and inspection.dataset.task is not None:
        name = inspection.dataset.task
        console().print(f"The file names its task: write `task: {name}` in params.yaml to score policies in MuJoCo.")


def params(*, preset: str = "small", algorithm: str | None = None, task: str | None = None) -> None:
    """Prints a complete params.yaml.

    Args:
        preset: tiny, small, base or paper.
        algorithm: trained with its published settings, such as mopo.
        task: whose settings of that algorithm, such as hopper-medium; the preset's if not given.
    """
    from envtf_lit.pipeline.published import published_params
    from envtf_lit.pipeline.yaml import params_yaml, preset_params

    if algorithm is None and task is not None:
        raise UserError(f"--task {task} says whose published settings are meant: say of which --algorithm, too.")
    found = preset_params(preset) if algorithm is None else published_params(algorithm, task, preset)
    sys.stdout.write(params_yaml(found))


def tutorial(
    name: Tutorial,
    /,
    *,
    notebooks: Folder = Path("notebooks"),
    out: Folder = Path("reports/notebooks"),
    tiny: bool = False,
    quiet: bool = False,
) -> None:
    """Executes a tutorial notebook.

    Args:
        name: such as 01_data.
        notebooks: folder of the tutorials.
        out: folder of the executed notebook and its HTML.
        tiny: in seconds: shows that it works, not that its result is good.
        quiet: without a progress bar.
    """
    from envtf_lit.project.tutorials import run_tutorial

    console().print(f"Wrote {run_tutorial(name, notebooks, out=out, tiny=tiny, progress=not quiet)}")


def doctor() -> None:
    """Prints what a bug report needs to know of this machine."""
    from envtf_lit.project.doctor import report

    for name, value in report().items():
        console().print(f"{name:<16} {value}")


FUNCTIONS = {"init": init, "params": params, "tutorial": tutorial, "doctor": doctor}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf init`, `envtf params`, `envtf tutorial` or `envtf doctor`."""
    run_command(FUNCTIONS[name], name, words)
