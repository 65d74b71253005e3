"""The stage `download`: makes, fetches or reads the dataset, and chooses the episodes that are held out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from envtf_lit.data.cards import dataset_card
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.options import DownloadOptions, check_download
from envtf_lit.data.sources.d4rl import load_d4rl
from envtf_lit.data.sources.fetch import fingerprint
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.data.sources.minari import describe_minari, read_minari
from envtf_lit.errors import UserError
from envtf_lit.files import write_json
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import CARD, DATASET, run_stage
from envtf_lit.robots.tasks import Task, get_task
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import describe_origin

MINARI_NOTE = (
    "Minari's datasets come from its own policies and are not D4RL's files: returns compare with those of policies in "
    "the same environment, and get no D4RL-normalised score here."
)
D4RL_NOTES = {
    True: "Scores are D4RL's own: returns of its file, by its references.",
    False: "This is not the file that D4RL publishes (another size or sum): its scores are not those of D4RL's tables.",
}


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
    return card


def make_dataset(
    task: Task | None, options: DownloadOptions, *, seed: int, workers: int, progress: bool = True
) -> tuple[OfflineDataset, dict[str, Any]]:
    """The task's dataset from `options.source`. Nothing else in the package reads the network.

    Args:
        task: robot and tier; of a file or a Minari dataset, only the robot must fit.
            None is a robot of the user's own, of which a file or Minari has data.
        options: the source, and what it needs.
        seed: of the zoo's environments and actions; the others have no use for it.
        workers: processes that collect; they do not change the result.
        progress: shows a bar with the time left.

    Returns:
        The dataset, and where it comes from: policies, URL or id, size and sum of the file; ready for JSON.

    Raises:
        UserError: the zoo lacks the task, a path or id is missing or not wanted, a download fails, or the data are bad.
    """
    check_download(options, named=task is not None)
    name = None if task is None else task.name
    match options.source:
        case "zoo":
            assert task is not None
            dataset = collect(task, options.transitions, seed=seed, workers=workers, progress=progress)
            return dataset, describe_origin(task, options.transitions, seed)
        case "d4rl":
            assert task is not None
            dataset, origin = load_d4rl(task, options.path, progress=progress)
            return dataset, origin | {"note": D4RL_NOTES[origin["published_file"]]}
        case "minari":
            assert options.minari_id is not None
            dataset = read_minari(options.minari_id, task=name, download=True)
            return _renamed(dataset, name), describe_minari(options.minari_id) | {"note": MINARI_NOTE}
        case "file":
            assert options.path is not None
            dataset = load_dataset(options.path, task=name)
            return _renamed(dataset, name), {"path": options.path, **fingerprint(Path(options.path))}


def _renamed(dataset: OfflineDataset, name: str | None) -> OfflineDataset:
    """Whatever a file calls its task, a user who names none wants none."""
    return replace(dataset, task=name)
