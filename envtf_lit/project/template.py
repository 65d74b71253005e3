"""The project that `envtf init` writes: the repository's own pipeline, without the repository's code."""

import shutil
import subprocess
from pathlib import Path

from ruamel.yaml import YAML

from envtf_lit.errors import UserError
from envtf_lit.files import replacing
from envtf_lit.pipeline.yaml import params_yaml, preset_params

PLAIN_FILES = (".dvcignore", ".gitignore")
DVC_CONFIG = "[core]\n    analytics = false\n    check_update = false\n"


def template_folder() -> Path:
    """Where the template's files lie: inside the installed package, or at the root of a checkout."""
    package = Path(__file__).parent.parent
    shipped = package / "template"
    return shipped if shipped.is_dir() else package.parent


def write_project(folder: Path, preset: str) -> None:
    """Writes dvc.yaml, params.yaml of that preset, notebooks, and DVC's settings into `folder`.

    Raises:
        UserError: no such preset, or a project is there already.
    """
    params = params_yaml(preset_params(preset))
    if (folder / "dvc.yaml").exists():
        raise UserError(
            f"{folder}/dvc.yaml exists already: choose another folder, or `envtf params` for a params.yaml."
        )
    source = template_folder()
    with replacing(folder / "notebooks") as notebooks:
        shutil.copytree(source / "notebooks", notebooks, ignore=shutil.ignore_patterns(".*"))
    for name in PLAIN_FILES:
        shutil.copyfile(source / name, folder / name)
    (folder / ".dvc").mkdir(exist_ok=True)
    (folder / ".dvc" / "config").write_text(DVC_CONFIG)
    (folder / ".dvc" / ".gitignore").write_text("/config.local\n/tmp\n/cache\n")
    if not _in_git(folder):
        (folder / ".dvc" / "config.local").write_text("[core]\n    no_scm = true\n")
    (folder / "params.yaml").write_text(params)
    _write_pipeline(source / "dvc.yaml", folder / "dvc.yaml")


def _write_pipeline(source: Path, target: Path) -> None:
    """Copies the pipeline less its dependencies on the package's source, which an installed package keeps elsewhere."""
    yaml = YAML()
    yaml.width = 120
    yaml.indent(mapping=2, sequence=4, offset=2)
    pipeline = yaml.load(source)
    for stage in pipeline["stages"].values():
        slots = {slot for item in stage.get("foreach", {}).values() for slot in item if _is_code(item[slot])}
        for item in stage.get("foreach", {}).values():
            for slot in slots:
                del item[slot]
        stage = stage.get("do", stage)
        ours = {f"${{item.{slot}}}" for slot in slots}
        stage["deps"] = [path for path in stage["deps"] if path not in ours and not _is_code(path)]
        if not stage["deps"]:
            del stage["deps"]
    with replacing(target) as temporary:
        yaml.dump(pipeline, temporary)


def _is_code(path: str) -> bool:
    return path.startswith("envtf_lit/")


def _in_git(folder: Path) -> bool:
    try:
        inside = subprocess.run(["git", "rev-parse"], cwd=folder, capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return inside.returncode == 0
