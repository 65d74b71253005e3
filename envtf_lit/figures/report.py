"""One run of the pipeline, as the report notebooks read and show it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from envtf_lit.errors import UserError
from envtf_lit.evaluation.comparison import Comparison, compare
from envtf_lit.evaluation.promises import Places, read_frontier
from envtf_lit.figures.inline import show_picture
from envtf_lit.files import read_json

MARKS = ("dvc.yaml", "params.yaml", "reports/metrics.json")  # a folder with one of these is a project
NOTEBOOKS = {True: "report.ipynb", False: "report_offline.ipynb"}  # by whether there is a simulator
NAMES = {"score": "points", "return": "of return", "imagined_return": "of imagined return"}


@dataclass(frozen=True, eq=False)
class Run:
    """What the stages of one run of the pipeline wrote.

    Attributes:
        root: folder of the project.
        metrics: `reports/metrics.json`.
        card: `data/dataset.json`.
        episodes: (E,) of each policy, by name: what `measure` says, from the same starts for every policy.
    """

    root: Path
    metrics: dict[str, Any]
    card: dict[str, Any]
    episodes: dict[str, np.ndarray]

    @property
    def simulated(self) -> bool:
        """Whether there is a simulator in which policies were scored."""
        return self.metrics["task"] is not None

    @property
    def unit(self) -> str:
        """The unit of the data's episodes: `score`, or `return` where there are no scores."""
        return "score" if "score_mean" in self.metrics["dataset"] else "return"

    @property
    def measure(self) -> str:
        """What policies are compared in: `score`, `return`, or `imagined_return` where there is no simulator."""
        return self.unit if self.simulated else "imagined_return"

    @property
    def recorded(self) -> float:
        """Mean of the recorded episodes that policies are compared with, in `unit`."""
        return self.metrics["dataset" if self.simulated else "held_out"][f"{self.unit}_mean"]

    @property
    def policies(self) -> dict[str, dict[str, Any]]:
        """What is known of each policy, by name, in the order of params.yaml."""
        return self.metrics["policies"]

    @property
    def last(self) -> str:
        """The name of the last policy: the one that the report is about."""
        return list(self.policies)[-1]

    @property
    def others(self) -> list[str]:
        """The names of all policies but the last."""
        return list(self.policies)[:-1]

    def label(self, policy: str) -> str:
        """What to call a policy."""
        return self.policies[policy]["label"]

    def mean(self, policy: str) -> float:
        """A policy's mean, in `measure`."""
        return self.policies[policy][f"{self.measure}_mean"]

    def std(self, policy: str) -> float:
        """The standard deviation of a policy's episodes, in `measure`."""
        return self.policies[policy][f"{self.measure}_std"]

    def imagines(self, policy: str) -> bool:
        """Whether a policy learned from imagination beside the data."""
        return self.policies[policy]["world_model"] is not None

    @property
    def least(self) -> float:
        """The least difference between policies that counts: a point, or the error of an imagined return."""
        if self.measure == "imagined_return":
            return self.metrics["held_out"]["imagined_return_error"]
        return 1.0 if self.measure == "score" else 0.0

    def compare(self, first: str, second: str) -> Comparison:
        """One policy against another, over the starts that they share."""
        return compare(self.episodes[first], self.episodes[second], least=self.least)

    def amount(self, difference: float) -> str:
        """A signed difference between policies, with its unit."""
        return f"{self.number(difference, sign='+')} {NAMES[self.measure]}"

    def number(self, value: float, sign: str = "") -> str:
        """A score or return, as text: a score with one decimal, a return with three digits or more."""
        decimal = self.measure == "score" or abs(value) >= 100
        return f"{value:{sign},.1f}" if decimal else f"{value:{sign}.3g}"

    @cached_property
    def frontiers(self) -> dict[str, Places]:
        """What is known of the actors between log and policy, from the clone outward, of policies that say so."""
        tables = {name: read_frontier(self.policy_folder(name)) for name in self.policies}
        return {name: table for name, table in tables.items() if table is not None}

    def trust(self, policy: str) -> str:
        """The level of trust that a policy with a frontier was trained with."""
        return read_json(self.policy_folder(policy) / "resolved.json")["options"]["trust"]

    @property
    def held_out(self) -> dict[str, float]:
        """What recorded actions earned, and what the model makes of them."""
        return self.metrics["held_out"]

    @property
    def recorded_return(self) -> float:
        """Mean return of the recorded episodes."""
        return self.card["returns"]["mean"]

    def policy_folder(self, policy: str) -> Path:
        """The folder of a policy."""
        return self.root / "models/policy" / policy

    @property
    def world_model_folder(self) -> Path:
        """The folder of the world model that was scored."""
        return self.root / "models/world_model" / self.metrics["world_model"]["name"]

    def policy_curves(self, policy: str) -> pd.DataFrame:
        """What a policy's training logged, a row per epoch."""
        return pd.read_csv(self.policy_folder(policy) / "curves.csv")

    def table(self, name: str) -> pd.DataFrame:
        """The numbers behind a plot."""
        return pd.read_csv(self.root / f"reports/plots/{name}.csv")

    def plot(self, name: str) -> None:
        """Displays a plot of the evaluate stage."""
        show_picture(self.root / f"reports/plots/{name}.png", name.replace("_", " "))

    def plot_frontier(self) -> None:
        """Displays the frontier of trust, where a policy has one."""
        if self.frontiers:
            self.plot("frontier")

    def video(self) -> None:
        """Displays the video of the evaluate stage."""
        show_picture(self.root / "reports/video/real_vs_imagined.gif", "real and imagined robot, side by side")


def read_run(root: str | Path, *, simulator: bool) -> Run:
    """Reads what the stages wrote.

    Args:
        root: a folder of the project, or one within it such as that of the notebooks.
        simulator: whether the notebook that asks is the one for runs with a simulator.

    Raises:
        UserError: there is no project, a stage has not run yet, the run needs the other notebook, or its plots and
            metrics are of different runs.
    """
    home = project_root(root)
    metrics, card = read_json(home / "reports/metrics.json"), read_json(home / "data/dataset.json")
    scores = pd.read_csv(home / "reports/plots/scores.csv")
    of_policies = scores[scores["kind"] == "policy"]
    episodes = {str(name): np.asarray(group["score"]) for name, group in of_policies.groupby("name", sort=False)}
    run = Run(home, metrics, card, episodes)
    if run.simulated != simulator:
        raise UserError(
            f"The task of this run is {metrics['task']}, whose report is notebooks/{NOTEBOOKS[run.simulated]}: "
            "open that one."
        )
    if list(episodes) != list(run.policies) or not all(_agree(run, policy) for policy in episodes):
        raise UserError(f"The metrics and plots in {home / 'reports'} are of different runs: run `dvc repro`.")
    return run


def project_root(start: str | Path) -> Path:
    """The project's folder: the nearest one from `start` upwards with a dvc.yaml, params.yaml or reports/metrics.json.

    Raises:
        UserError: there is none.
    """
    folder = Path(start).resolve()
    for place in (folder, *folder.parents):
        if any((place / mark).is_file() for mark in MARKS):
            return place
    raise UserError(f"Neither {folder} nor a folder above it has a dvc.yaml: give `root`, the folder of the project.")


def _agree(run: Run, policy: str) -> bool:
    episodes = run.episodes[policy]  # written with six digits
    return abs(episodes.mean() - run.mean(policy)) <= 1e-5 * max(1.0, abs(episodes).max())
