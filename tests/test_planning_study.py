"""`envtf plan`, and the study of planners on a pendulum."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.planning import score_planner
from envtf_lit.planning.pendulum import TruePendulum
from envtf_lit.policy import PredictingPolicy, save_policy
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.studies.planning import (
    FAMILIES,
    PlanningOptions,
    angles,
    picture,
    planning_table,
    play,
    run_planning,
    watch,
)
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.logs import dataset_of_chains
from tests.test_planning import SMALL

# the command line


@pytest.fixture(scope="module")
def hopper_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world model of Hopper that knows nothing, and a policy of as little, in folders `model` and `policy`."""
    folder = tmp_path_factory.mktemp("hopper")
    torch.manual_seed(0)
    save_world_model(folder / "model", EnvironmentTransformer(11, 3, layers=1, heads=1, width=8, context=2))
    save_policy(folder / "policy", TanhGaussianActor(11, 3, hidden=(8,)))
    return folder


def envtf_plan(folder: Path, *words: str) -> list[str]:
    common = ["plan", "--world-model", str(folder / "model"), "--task", "hopper-medium", "--quiet", "--threads", "1"]
    return [*common, "--steps", "5", "--option", "horizon=3", "--option", "samples=8", *words]


def test_envtf_plan_plays_a_planner_beside_its_prior(
    hopper_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "plan.json"
    main(envtf_plan(hopper_model, "--policy", str(hopper_model / "policy"), "--out", str(out)))
    said = capsys.readouterr().out
    assert re.search(r"mppi +-?[\d.]+ +-?[\d.]+ +5 +[\d.]+ *\n *policy ", said)
    assert said.count("mppi") == 1  # it is played once
    found = json.loads(out.read_text())
    assert found["options"] == ["horizon=3", "samples=8"] and found["decisions_per_second"] > 1
    assert len(found["returns"]) == len(found["prior_returns"]) == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--option", "horizon=0"], "horizon is 0, expected an integer, more than 0"),
        (["--option", "horizont=3"], "Unknown option 'horizont'.*did you mean 'horizon'"),
        (["--option", "horizon"], "write --option horizon=20"),
        (["--task", "walker2d-medium"], "observations of size 11.*walker2d has 17 and 6"),
        (["--world-model", "nowhere"], "nowhere"),
        (["--video", "x.gif"], "name them with --dataset"),
        (["--planner", "mpi"], "did you mean 'mppi'"),
    ],
)
def test_envtf_plan_refuses_in_one_sentence(
    words: list[str], sentence: str, hopper_model: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stop:
        main(envtf_plan(hopper_model, *words))
    assert stop.value.code == 2
    assert re.search(sentence, capsys.readouterr().err)


def test_a_policy_of_another_robot_is_refused(hopper_model: Path, tmp_path: Path):
    save_policy(tmp_path / "policy", TanhGaussianActor(17, 6, hidden=(8,)))
    with pytest.raises(UserError, match="policy of observations of size 17, and hopper has 11"):
        score_planner(hopper_model / "model", ROBOTS["hopper"], "mppi", policy=tmp_path / "policy", episodes=1, seed=0)


class Constant:
    """A learner with stable-baselines3's way to ask for actions, who always pushes alike."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((len(observation), 1), 1.5 if deterministic else 0.5, np.float32), None


def test_an_episode_that_is_watched_is_the_one_that_is_played():
    policy, options = PredictingPolicy(Constant()), PlanningOptions(episodes=1, steps=7, seed=3)
    seen = watch(policy, seed=3, steps=7)
    rate = np.diff(np.unwrap(angles(seen))) / 0.05
    assert seen.shape == (8, 3) and np.allclose(rate, seen[1:, 2], atol=1e-4)
    paid = -(angles(seen[:-1]) ** 2 + 0.1 * seen[:-1, 2] ** 2 + 0.001 * 1.5**2).sum()
    assert play(policy, options)[0] == pytest.approx(paid, rel=1e-4)
    assert policy.act(torch.zeros(2, 3), False).tolist() == [[0.5], [0.5]]


def test_a_plan_is_drawn_of_the_planner_that_is_named():
    found = picture(TruePendulum(), 0, "mppi", SMALL["mppi"])
    assert found.title == "mppi" and found.taken[1].shape == (1, SMALL["mppi"].horizon)


@pytest.mark.slow
def test_the_study_measures_every_family_and_draws_a_plan(tmp_path: Path):
    """Through a model that was hardly trained, in episodes too short to swing up."""
    options = PlanningOptions(transitions=400, updates=2, episodes=1, steps=10, decisions=1)
    small = {name: replace(value, horizon=2) for name, value in SMALL.items()}
    out, work = tmp_path / "planning.json", tmp_path / "work"
    found = run_planning(out, work=work, options=options, planners=small, progress=False)
    assert json.loads(out.read_text()) == found
    with Image.open(out.with_suffix(".png")) as picture:
        assert min(picture.size) > 300
    assert all(np.isfinite(found[f"{family}.share"]) for family in FAMILIES)
    assert planning_table(found).count("\n") == len(FAMILIES) + 1
    trained = (work / "pendulum-400-2-0/world_model/weights.safetensors").stat().st_mtime_ns
    assert run_planning(work=work, options=options, planners=small, progress=False) == found
    assert (work / "pendulum-400-2-0/world_model/weights.safetensors").stat().st_mtime_ns == trained
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(UserError, match="no earlier result"):
        run_planning(tmp_path / "notes.json", work=work, options=options, progress=False)


@pytest.mark.slow
def test_the_video_shows_both_worlds(hopper_model: Path, tmp_path: Path):
    save_dataset(dataset_of_chains(width=11, actions=3).with_split(0.3, 0), tmp_path / "data.h5")
    main(envtf_plan(hopper_model, "--video", str(tmp_path / "plan.gif"), "--dataset", str(tmp_path / "data.h5")))
    with Image.open(tmp_path / "plan.gif") as video:
        assert video.n_frames > 1  # pyright: ignore[reportAttributeAccessIssue]
