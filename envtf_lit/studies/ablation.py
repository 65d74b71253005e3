"""The ablation study of long horizons: the transformer trained once per variant, each of which changes one thing.

All variants are trained on the same data with as many steps per update, and measured beside the suite's three models as
`envtf horizon` does: the same JSON, page and figures.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from envtf_lit.studies.horizon import HorizonOptions, HorizonStudy
from envtf_lit.studies.study import run_study
from envtf_lit.studies.suite import WORK, SuiteOptions, model_options
from envtf_lit.world_models.options import TransformerOptions


def _context(plain: TransformerOptions, steps: int) -> TransformerOptions:
    """Windows of so many steps, as many steps per update."""
    windows = plain.batch_size * plain.context // steps
    return replace(plain, context=steps, batch_size=windows)


# from the options of the suite's transformer
VARIANTS: dict[str, Callable[[TransformerOptions], TransformerOptions]] = {
    "context_8": lambda plain: _context(plain, 8),
    "context_32": lambda plain: _context(plain, 32),
    "updates_x2": lambda plain: replace(plain, updates=2 * plain.updates),
    "updates_x4": lambda plain: replace(plain, updates=4 * plain.updates),
    "bounded": lambda plain: replace(plain, bounded=True),
}


def run_ablation(
    out: Path,
    *,
    robot: str = "hopper",
    tier: str = "medium-replay",
    work: Path = WORK,
    options: SuiteOptions,
    measured: HorizonOptions,
    names: Collection[str] = VARIANTS.keys(),
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """The horizon study of one robot's suite and of variants of its transformer.

    Args:
        out: JSON file to write; a page and a folder of figures of that name lie beside it.
        robot: its name.
        tier: of the data.
        work: folder of suites; what was trained or measured there before with the same options is used again.
        options: of the suite.
        measured: how many episodes.
        names: of the variants, among `VARIANTS`.
        progress: shows bars.
        report: called with a line for each thing done.

    Returns:
        What the file holds, as `run_study` says.

    Raises:
        UserError: as `run_study`.
    """
    plain = model_options("transformer", options)
    assert isinstance(plain, TransformerOptions)
    return run_study(
        HorizonStudy(measured),
        out,
        robots=[robot],
        tier=tier,
        work=work,
        options=options,
        variants={name: VARIANTS[name](plain) for name in names},
        progress=progress,
        report=report,
    )
