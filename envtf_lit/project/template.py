"""The project that `envtf init` writes: the repository's own pipeline, without the repository's code."""

import os
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ruamel.yaml import YAML

from envtf_lit.data.options import DownloadOptions
from envtf_lit.errors import UserError
from envtf_lit.files import replacing, write_text
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.yaml import params_yaml, preset_params

PLAIN_FILES = (".dvcignore", ".gitignore")
DVC_CONFIG = "[core]\n    analytics = false\n    check_update = false\n"


def template_folder() -> Path:
    """Where the template's files lie: inside the installed package, or at the root of a checkout."""
    package = Path(__file__).parent.parent
    shipped = package / "template"
    return shipped if shipped.is_dir() else package.parent


def write_project(folder: Path, preset: str, data: Path | None = None) -> list[str]:
    """Writes dvc.yaml, params.yaml of that preset, the report's notebooks, and DVC's settings into `folder`.

    Nothing that lies there is changed. Settings of git and DVC that are there already stay in force.

    Args:
        folder: created if missing.
        preset: of the options.
        data: log of a robot without a simulator that takes the place of the zoo's; None keeps that.

    Returns:
        The names of those settings.

    Raises:
        UserError: no such preset, a project is there already, or other files have the names of the project's.
    """
    params = preset_params(preset)
    params = params_yaml(params if data is None else _of_own_robot(params, folder, data))
    if os.path.lexists(folder / "dvc.yaml"):
        raise UserError(
            f"{folder}/dvc.yaml exists already: choose another folder, or `envtf params` for a params.yaml."
        )
    source = template_folder()
    files = {f"notebooks/{path.name}": path.read_text("utf-8") for path in (source / "notebooks").glob("report*.ipynb")}
    files["params.yaml"] = params
    settings = {name: (source / name).read_text("utf-8") for name in PLAIN_FILES} | _dvc_settings(folder)
    kept = [name for name in settings if (folder / name).is_file()]
    missing = {name: text for name, text in (settings | files).items() if name not in kept}
    _refuse_others(folder, missing)
    for name, text in missing.items():
        write_text(folder / name, text)
    _write_pipeline(source / "dvc.yaml", folder / "dvc.yaml")
    return [name for name in kept if (folder / name).read_bytes() != settings[name].encode()]


def _of_own_robot(params: Params, folder: Path, data: Path) -> Params:
    """The options with a log of one's own, at its place as seen from the project."""
    path = os.path.relpath(os.path.abspath(data.expanduser()), os.path.realpath(folder))
    return replace(params, task=None, download=DownloadOptions(source="file", path=path))


def _dvc_settings(folder: Path) -> dict[str, str]:
    """For a folder outside git they say so where DVC's own advice, once there is git, takes it back."""
    config = DVC_CONFIG if _in_git(folder) else f"{DVC_CONFIG}    no_scm = true\n"
    return {".dvc/config": config, ".dvc/.gitignore": "/config.local\n/tmp\n/cache\n"}


def _refuse_others(folder: Path, files: Mapping[str, str]) -> None:
    """Raises UserError if anything but these very files stands in their place, or a file in that of their folders."""
    places = dict[str, str | None](files) | {os.path.dirname(name): None for name in files if "/" in name}
    others = [name for name, text in places.items() if os.path.lexists(folder / name) and not _is(folder / name, text)]
    if others:
        raise UserError(
            f"{folder} has files of the names that the project's have ({', '.join(sorted(others))}): move or rename "
            "them, or choose another folder. Nothing was written."
        )


def _is(path: Path, text: str | None) -> bool:
    """Whether it is a file of that text; without one, a folder."""
    return path.is_dir() if text is None else path.is_file() and path.read_bytes() == text.encode()


def _write_pipeline(source: Path, target: Path) -> None:
    """Copies the pipeline less its dependencies on the package's source, which an installed package keeps elsewhere."""
    yaml = YAML()
    yaml.width = 120
    yaml.indent(mapping=2, sequence=4, offset=2)
    pipeline = yaml.load(source)
    for stage in pipeline["stages"].values():
        stage = stage.get("do", stage)
        stage["deps"] = [path for path in stage["deps"] if not path.startswith("envtf_lit/")]
        if not stage["deps"]:
            del stage["deps"]
    with replacing(target) as temporary:
        yaml.dump(pipeline, temporary)


def _in_git(folder: Path) -> bool:
    nearest = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.is_dir())
    try:
        inside = subprocess.run(["git", "rev-parse"], cwd=nearest, capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return inside.returncode == 0
