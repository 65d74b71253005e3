"""The stage `download`: makes, fetches or reads the dataset, and chooses the episodes that are held out."""

from pathlib import Path
from typing import Any

import h5py

from envtf_lit.data.cards import dataset_card
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import replacing, write_json, write_text
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.sources import make_dataset
from envtf_lit.pipeline.stage import CARD, DATASET, NOTHING, run_stage
from envtf_lit.robots.tasks import get_task


def download(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Makes or reads the dataset, and chooses its held-out episodes: `data/dataset.h5` and its card, which is returned.

    Raises:
        UserError: the file to be read is the one to be written, the data are bad, or have a single episode.
    """
    own, target = params.download.path, root / DATASET
    if own is not None and target.exists() and Path(own).exists() and target.samefile(own):
        raise UserError(
            f"download.path is {own}, which `download` itself writes: move your file to another place, and name that."
        )
    with run_stage("download", params, root):
        dataset, origin = make_dataset(
            None if params.task is None else get_task(params.task),
            params.download,
            seed=params.seed,
            workers=params.threads,
            progress=progress,
        )
        if dataset.held_out is None:
            dataset = dataset.with_split(params.download.held_out, params.seed)
        save_dataset(dataset, target)
        card = dataset_card(dataset, params.download.source, origin)
        write_json(root / CARD, card)
        _write_nothing(root)
    return card


def _write_nothing(root: Path) -> None:
    """What policies that learn from data alone read in place of a world model and its rollouts."""
    model, rollouts = (root / path for path in NOTHING)
    write_text(model, "Policies whose world_model is `none` learn from data alone.\n")
    with replacing(rollouts) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["note"] = "no rollouts: for policies whose world_model is `none`"
