"""`envtf horizon` from end to end, on episodes of at most twelve steps and models that have hardly learned."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.axes import Axes
from PIL import Image

from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.evaluation import tracking
from envtf_lit.evaluation.tracking import fresh_episodes
from envtf_lit.figures import horizons
from envtf_lit.figures.style import LABELS
from envtf_lit.robots import tasks
from envtf_lit.robots.tasks import ROBOTS, Task
from envtf_lit.studies import horizon, study
from envtf_lit.studies.ablation import VARIANTS, run_ablation
from envtf_lit.studies.horizon import ONLINE, SIZES, HorizonOptions, HorizonStudy
from envtf_lit.studies.study import run_study
from envtf_lit.studies.suite import MODELS, Suite, SuiteOptions, build_suite, model_options
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer

ENSEMBLE = EnsembleOptions(
    members=2, elites=1, hidden=(8,), weight_decay=(0.0, 0.0), updates=2, updates_per_epoch=2, batch_size=8
)
TINY = SuiteOptions(transitions=1_000, updates=2, context=8, ensemble=ENSEMBLE, threads=1)
FEW = HorizonOptions(6, 3)
PROMISED = (
    "open_loop_0.01",
    "open_loop_0.1",
    "teacher_forced_0.01",
    "explosion_rate",
    "ceiling_0.01",
    "ceiling_explosion_rate",
)


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = replace(ROBOTS["hopper"], max_episode_steps=12)
    monkeypatch.setitem(tasks.TASKS, "hopper-medium", Task(robot, "medium"))
    monkeypatch.setattr(tracking, "PROBE", 100)


def run(folder: Path, lines: list[str], measured: HorizonOptions = FEW, **options: Any) -> dict[str, Any]:
    facts: dict[str, Any] = dict(robots=["hopper"], tier="medium", work=folder / "work", options=TINY, progress=False)
    return run_study(HorizonStudy(measured), folder / "out/horizon.json", report=lines.append, **facts | options)


@pytest.mark.usefixtures("small_models", "short_episodes")
def test_every_model_is_measured_once_and_all_of_it_is_written(tmp_path: Path) -> None:
    lines = list[str]()
    numbers = run(tmp_path, lines)
    assert json.loads((tmp_path / "out/horizon.json").read_text()) == numbers
    for name in MODELS:
        assert {f"hopper.{name}.{key}" for key in PROMISED} <= numbers.keys()
        assert numbers[f"hopper.{name}.trajectories"] == 6
        assert numbers[f"hopper.{name}.expert.trajectories"] == 3
        assert numbers[f"hopper.{name}.open_loop_0.01"] <= numbers[f"hopper.{name}.open_loop_0.1"] <= 12
        assert numbers[f"hopper.{name}.train_seconds"] > 0
        assert all(f"hopper.{name}.{policy}.open_loop_0.1" in numbers for policy in ONLINE)
    ceilings = [numbers[f"hopper.physics.{size:g}.ceiling_0.01"] for size in SIZES]
    assert ceilings[-1] < min(ceilings[:-1])
    assert numbers["suite.updates"] == 2 and "versions.mujoco" in numbers
    assert len(lines) == 2 + len(MODELS) and "min left" in lines[0]
    table = (tmp_path / "out/horizon.md").read_text()
    assert table.count("| hopper | transformer |") == 1 + len(ONLINE)
    for name in ("open_loop", "teacher_forced", "online", "ceiling"):
        with Image.open(tmp_path / f"out/horizon/{name}.png") as figure:
            assert figure.size[0] > 500
        drawn = pd.read_csv(tmp_path / f"out/horizon/{name}.csv")
        assert set(MODELS) <= set(drawn["model"])

    with pytest.raises(UserError, match="No episode of hopper-medium lasts longer than 12 steps"):
        run(tmp_path, lines, measured=HorizonOptions(6, 3, start=12))
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("*") if path.is_file()}
    other = {"mine": str(tmp_path / "work/{task}/models/ensemble")}
    again = run(tmp_path, lines, others=other)
    assert numbers.items() <= again.items()
    assert again["hopper.mine.open_loop_0.1"] == numbers["hopper.ensemble.open_loop_0.1"]
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


@pytest.mark.usefixtures("small_models", "short_episodes")
def test_a_policy_whose_episodes_all_end_before_the_start_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fresh(task: Task, *arguments: Any, **options: Any) -> Any:
        steps = 3 if task.tier == "random" else 12
        return fresh_episodes(replace(task, robot=replace(task.robot, max_episode_steps=steps)), *arguments, **options)

    monkeypatch.setattr(horizon, "fresh_episodes", fresh)
    numbers = run(tmp_path, [], models=["ensemble"], measured=HorizonOptions(4, 2, start=5))
    assert not any(".random." in key for key in numbers)
    assert "hopper.ensemble.expert.open_loop_0.1" in numbers
    assert "| random |" not in (tmp_path / "out/horizon.md").read_text()
    assert set(pd.read_csv(tmp_path / "out/horizon/online.csv")["source"]) == {"medium", "expert"}


@pytest.mark.usefixtures("small_models", "short_episodes")
def test_what_was_measured_is_written_before_the_next_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build(task: str, *arguments: Any, **options: Any) -> Suite:
        if task != "hopper-medium":
            raise KeyboardInterrupt
        return build_suite(task, *arguments, **options)

    monkeypatch.setattr(study, "build_suite", build)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [], robots=["hopper", "walker2d"], models=["context_1"])
    assert "hopper.context_1.open_loop_0.1" in json.loads((tmp_path / "out/horizon.json").read_text())
    assert "| hopper | context_1 |" in (tmp_path / "out/horizon.md").read_text()
    assert (tmp_path / "out/horizon/ceiling.png").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"tier": "meduim"}, "hopper-meduim"),
        ({"others": {"ensemble": "x"}}, "cannot be called 'ensemble'"),
        ({"others": {"mine": "no/{robot}"}}, "no/hopper is not a model folder"),
        ({"measured": HorizonOptions(300, 0)}, "at least one trajectory"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_any_work(
    tmp_path: Path, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(UserError, match=sentence):
        run(tmp_path, [], **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("small_models", "short_episodes")
def test_variants_are_trained_and_measured_beside_the_suite(tmp_path: Path) -> None:
    out, names = tmp_path / "ablation.json", ["context_8", "updates_x2"]
    options = replace(TINY, context=16)
    numbers = run_ablation(
        out, tier="medium", work=tmp_path, options=options, measured=FEW, names=names, progress=False
    )
    assert json.loads(out.read_text()) == numbers
    assert all(f"hopper.{name}.open_loop_0.1" in numbers for name in (*MODELS, *names))
    assert numbers["hopper.updates_x2.updates"] == 2 * numbers["hopper.context_8.updates"] == 4
    changed, plain = (
        load_world_model(tmp_path / f"hopper-medium/models/{name}") for name in ("context_8", "transformer")
    )
    assert isinstance(changed, EnvironmentTransformer) and isinstance(plain, EnvironmentTransformer)
    assert changed.options == replace(plain.options, context=8)
    assert set(pd.read_csv(tmp_path / "ablation/ceiling.csv")["model"]) == {*MODELS, *names, "physics"}


def test_variants_see_as_many_steps_per_update() -> None:
    plain = model_options("transformer", SuiteOptions())
    assert isinstance(plain, TransformerOptions)
    for change in VARIANTS.values():
        train = change(plain)
        assert train != plain and train.batch_size * train.context == plain.batch_size * plain.context


@pytest.mark.parametrize("command", ["horizon", "calibrate"])
def test_a_model_needs_a_name_and_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--out", str(tmp_path / "out.json"), "--model", "rambo"])
    assert stop.value.code == 2
    assert "write --model NAME=FOLDER" in capsys.readouterr().err


def test_the_legend_names_the_models_of_all_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = pd.DataFrame(
        [
            dict(robot=robot, model=model, run="open_loop", step=h, lower=0.1, median=0.2, upper=0.3, trajectories=9)
            for robot, model in (("hopper", "transformer"), ("hopper", "context_1"), ("ant", "transformer"))
            for h in (1, 2)
        ]
    )
    shown = list[str]()
    monkeypatch.setattr(Axes, "legend", lambda axis, handles, labels, **looks: shown.extend(labels))
    horizons.error_growth(table, "open_loop", tmp_path / "growth.png")
    assert shown == [LABELS["transformer"], LABELS["context_1"]]
