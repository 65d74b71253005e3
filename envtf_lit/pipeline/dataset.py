"""The dataset that the stages after `download` read."""

from pathlib import Path

from envtf_lit.data.sources.files import stored_task
from envtf_lit.errors import UserError
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import DATASET
from envtf_lit.robots.tasks import find_task, get_task


def dataset_of(params: Params, root: Path) -> Path:
    """The dataset's file, of the task's robot.

    Raises:
        UserError: there is no dataset, or it was made for another robot.
    """
    path = root / DATASET
    made_for = find_task(stored_task(path) or "")
    if params.task is not None and made_for is not None and made_for.robot != get_task(params.task).robot:
        raise UserError(
            f"{path} was made for {made_for.name}, and task is {params.task}: run `envtf download` for that task, or "
            f"set task to {made_for.name}."
        )
    return path
