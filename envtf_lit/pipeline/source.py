"""The stage `source`: notes what DVC cannot know by itself, at every run.

That is the checksum of a file of one's own, whose content may have changed, and what stands in place of the world model
where a policy learns from data alone.
"""

from pathlib import Path
from typing import Any

from envtf_lit.data.sources.fetch import sha256
from envtf_lit.errors import UserError
from envtf_lit.files import write_json, write_text
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import NOTHING, SOURCE


def source(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Writes `data/source.json`: path and SHA-256 of the file that `download.path` names, or null for both.

    Beside it, what policies that learn from data alone read in place of a world model and its rollouts.

    Raises:
        UserError: there is no such file.
    """
    path = params.download.path
    if path is not None and not Path(path).is_file():
        raise UserError(f"download.path is {path}, which is not a file: check the path.")
    noted = {"path": path, "sha256": None if path is None else sha256(Path(path))}
    write_json(root / SOURCE, noted)
    for place in NOTHING:
        write_text(root / place, "Policies whose world_model is `none` learn from data alone.\n")
    return noted
