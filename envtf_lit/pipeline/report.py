"""The stage `report`: executes the report notebook."""

from pathlib import Path
from typing import Any

from envtf_lit.errors import missing_extra
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.stage import REPORTS, run_stage


def report(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Executes the report notebook on the other stages' outputs: `reports/report.ipynb` and `.html`.

    It is `notebooks/report.ipynb`, or for a robot without a simulator (`task: null`) `notebooks/report_offline.ipynb`.

    Raises:
        UserError: the extra `pipeline` is missing, or a cell failed.
    """
    try:
        from envtf_lit.figures.notebook import execute
    except ModuleNotFoundError as error:
        raise missing_extra("The report needs papermill and nbconvert", "pipeline", error) from None
    with run_stage("report", params, root):
        page = execute(
            root / "notebooks" / ("report.ipynb" if params.task is not None else "report_offline.ipynb"),
            root / REPORTS / "report.ipynb",
            {"root": "."},
            cwd=root,
            progress=progress,
        )
    return {"report": str(page)}
