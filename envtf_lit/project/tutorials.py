"""The tutorials: notebooks that run in minutes with nothing but this package, and in seconds at a tiny size."""

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from envtf_lit.errors import UserError, did_you_mean, missing_extra

TINY = "tiny.yaml"  # beside the notebooks: the parameters that make each run in seconds


def run_tutorial(
    name: str, folder: Path = Path("notebooks"), *, out: Path, tiny: bool = False, progress: bool = False
) -> Path:
    """Executes a tutorial, in its own folder as JupyterLab would, and writes it with its outputs.

    Args:
        name: of the notebook, without its ending.
        folder: where the notebooks lie, and `tiny.yaml` beside them.
        out: folder of the executed notebook and of its HTML, which needs no network.
        tiny: runs it at its size of the tests, which shows that it works, not that its result is good.
        progress: shows a bar.

    Returns:
        The HTML's path.

    Raises:
        UserError: there is no such tutorial, a cell failed, or the extra `pipeline` is missing.
    """
    try:
        from envtf_lit.figures.notebook import execute
    except ModuleNotFoundError as error:
        raise missing_extra("Tutorials need papermill and nbconvert", "pipeline", error) from None
    known = tutorials(folder)
    if name not in known:
        raise UserError(f"{folder} has no tutorial {name!r}: {did_you_mean(name, known)}")
    return execute(
        folder / f"{name}.ipynb",
        out / f"{name}.ipynb",
        tiny_parameters(name, folder) if tiny else {},
        cwd=folder,
        folded=False,
        progress=progress,
    )


def tutorials(folder: Path = Path("notebooks")) -> list[str]:
    """The names of a folder's tutorials, in their order: notebooks whose names begin with a number.

    Raises:
        UserError: there is none.
    """
    names = sorted(path.stem for path in folder.glob("[0-9]*.ipynb"))
    if not names:
        raise UserError(
            f"{folder} has no tutorials: run it in a checkout of the repository, or name its notebooks/ with "
            "--notebooks DIR."
        )
    return names


def tiny_parameters(name: str, folder: Path = Path("notebooks")) -> dict[str, Any]:
    """The parameters of a tutorial's tiny size.

    Raises:
        UserError: `tiny.yaml` has no section of that name.
    """
    sections = YAML(typ="safe", pure=True).load(folder / TINY)
    if name not in sections:
        raise UserError(f"{folder / TINY} has no section {name}: give the parameters with which it runs in seconds.")
    return dict(sections[name])
