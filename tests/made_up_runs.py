"""Made-up outputs of the stages before the report, and what an executed notebook says of them."""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pandas as pd
import torch
from analytic import linear_data, linear_world
from PIL import Image

from envtf_lit.agents.trust_levels import COLUMNS
from envtf_lit.data.cards import dataset_card
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import (
    collect_metrics,
    collect_offline_metrics,
    held_out_metrics,
    world_model_metrics,
)
from envtf_lit.evaluation.offline import OfflineEstimate, OfflineEstimates
from envtf_lit.evaluation.promises import Places
from envtf_lit.figures import gallery
from envtf_lit.figures.video import no_video, write_gif
from envtf_lit.files import write_json, write_table
from envtf_lit.imagination.rollouts import Rollouts
from envtf_lit.robots.returns import Episode, Returns
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.forecast import Scale, whole_episodes

HOPPER = ROBOTS["hopper"]
LABELS = {"clone": "BC", "plain": "CQL", "dreamer": "ET + CQL"}
LEARNED = {
    "clone": {"algorithm": "bc", "world_model": None, "effective_episodes": None},
    "plain": {"algorithm": "cql", "world_model": None, "effective_episodes": 20.04},
    "dreamer": {"algorithm": "et_cql", "world_model": "small", "effective_episodes": 7.8},
}
LEVELS = {"clone": 400.0, "plain": 900.0, "dreamer": 200.0}  # returns, of an experiment that went against us


def said(notebook: Path) -> str:
    """All sentences that its code printed, of which none may be a complaint."""
    cells = nbformat.read(notebook, 4).cells
    outputs = [output for cell in cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "stream" and output.name == "stderr"]
    return " ".join(output.data["text/markdown"] for output in outputs if "text/markdown" in output.get("data", {}))


def some_returns(level: float, episodes: int = 3) -> Returns:
    values = level + np.arange(float(episodes))
    scores = np.array([HOPPER.normalised_score(value) for value in values])
    episode = Episode(0, np.zeros((2, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros((2, 6)))
    return Returns(returns=values, lengths=np.ones(episodes), scores=scores, median=episode)


def some_rollouts(steps: int = 3, rollouts: int = 50) -> Rollouts:
    """The uncertainty grows along them; none ends before its last step."""
    grid = (steps, rollouts)
    states, flags = torch.zeros(*grid, 2), torch.zeros(grid, dtype=torch.bool)
    uncertainty = torch.linspace(0.1, 1.0, steps * rollouts).reshape(grid)
    return Rollouts(
        observations=states, actions=torch.zeros(*grid, 1), rewards=torch.zeros(grid), next_observations=states,
        terminated=flags, halted=flags, aleatoric=torch.zeros(*grid, 3), uncertainty=uncertainty, valid=~flags,
    )  # fmt: skip


def some_estimates() -> OfflineEstimates:
    """Three held-out episodes, on which the model errs by 10."""
    recorded = np.array([300.0, 310.0, 320.0])
    policies = {name: OfflineEstimate(level + np.arange(3.0), 0.5) for name, level in LEVELS.items()}
    lengths = np.array([40, 50, 45])
    return OfflineEstimates(recorded=recorded, imagined=recorded + 10.0, lengths=lengths, policies=policies)


def some_frontier(kept: int = 2) -> Places:
    """The clone and two actors further out, of which one is published; the last strays from what the model knows."""
    rows = [
        (0, 0.0, 310.0, 2.0, 306.0, 314.0, 0.001, 45.0),
        (200, 0.05, 350.0, 3.0, 344.0, 356.0, 0.002, 45.0),
        (400, 0.2, 420.0, 5.0, 410.0, 430.0, 0.03, 90.0),
    ]
    return [dict(zip(COLUMNS, row, strict=True)) | {"kept": float(place == kept)} for place, row in enumerate(rows)]


def made_up_run(root: Path, source: str = "file", *, simulator: bool = True) -> Path:
    """What the stages before the report write, for a policy that imagines and does worse than those from data alone."""
    for name, content in _files(source, simulator).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


@cache
def _files(source: str, simulator: bool) -> dict[Path, bytes]:
    """The run's files, whose pictures take seconds."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        _write(root, source, simulator)
        return {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def _write(root: Path, source: str, simulator: bool) -> None:
    data, plots = linear_data((40, 50), noise=0.02), root / "reports/plots"
    model_curves = pd.DataFrame({"epoch": [1], "train/loss": [1.0], "val/loss": [1.1], "val/open_loop_error": [0.2]})
    curves = {name: pd.DataFrame({"epoch": [1], "train/q_data": [3.0]}) for name in ("plain", "dreamer")}
    curves["clone"] = pd.DataFrame({"epoch": [1], "train/clone_loss": [1.0]})
    scale = Scale.of(data)
    report = horizon_report(linear_world(0.02, std=0.02), whole_episodes(data, 1, seed=0), scale)
    gallery.draw_dataset(data, source, plots)
    gallery.draw_world_model(report, scale, HOPPER if simulator else None, model_curves, plots)
    gallery.draw_rollouts(some_rollouts(), plots)
    gallery.draw_policy_curves({name: curves[name] for name in LABELS}, LABELS, plots)
    termination = {"termination": "rule" if simulator else "learned"}
    world_model = {"name": "small"} | world_model_metrics(report, scale, parameters=12) | termination
    facts = dict(seed=3, dataset=data, world_model=world_model, rollouts={"transitions": 9}, labels=LABELS)
    metrics = _simulated(root, data, source, facts) if simulator else _estimated(root, facts)
    for name, learned in LEARNED.items():
        metrics["policies"][name] |= learned
    if simulator:
        metrics["policies"]["dreamer"] |= {"clone_return_mean": 280.0}
    measured = {"dreamer": 201.0, "dreamer/clone": 280.0} if simulator else {}
    gallery.draw_frontiers({"dreamer": some_frontier()}, metrics["held_out"], data, source, LABELS, measured, plots)
    tables = {"world_model/small": model_curves} | {f"policy/{name}": table for name, table in curves.items()}
    for name, table in tables.items():
        (root / "models" / name).mkdir(parents=True)
        table.to_csv(root / "models" / name / "curves.csv", index=False)
    write_table(root / "models/policy/dreamer/frontier.csv", some_frontier())
    write_json(root / "models/policy/dreamer/resolved.json", {"options": {"trust": "default"}})
    found = {"termination_recall": 0.5, "termination_false_alarms": 0.01}
    write_json(root / "models/world_model/small/metrics.json", found)
    write_json(root / "reports/metrics.json", metrics)
    write_json(root / "data/dataset.json", dataset_card(data, source, {"path": "my.h5", "note": "A note."}))


def _simulated(root: Path, data: OfflineDataset, source: str, facts: dict[str, Any]) -> dict[str, Any]:
    returns = {name: some_returns(level) for name, level in LEVELS.items()}
    gallery.draw_scores(data, source, HOPPER, returns, LABELS, root / "reports/plots")
    write_gif([Image.new("RGB", (8, 8))], root / "reports/video/real_vs_imagined.gif")
    facts |= {"held_out": held_out_metrics(some_estimates())}
    return collect_metrics(returns, task="hopper-medium-replay", source=source, robot=HOPPER, **facts)


def _estimated(root: Path, facts: dict[str, Any]) -> dict[str, Any]:
    gallery.draw_estimates(some_estimates(), LABELS, root / "reports/plots")
    (root / "reports/video").mkdir()
    no_video(root / "reports/video")
    return collect_offline_metrics(some_estimates(), **facts)
