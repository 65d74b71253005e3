"""`envtf plan`, and the study of planners on a pendulum."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from PIL import Image

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.critics import Critics, load_critics, save_critics
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.planning import planner_of, robot_to_plan_for, score_planner
from envtf_lit.planning.objective import imagined_paths
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
from envtf_lit.world_models.store import load_world_model, save_world_model
from envtf_lit.world_models.termination_head import TerminationHead, save_termination
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


@pytest.fixture
def judged(hopper_model: Path, tmp_path: Path) -> Path:
    """The policy's folder, with critics of another discount than the planner's own."""
    shutil.copytree(hopper_model / "policy", tmp_path / "judged")
    save_critics(tmp_path / "judged", Critics(11, 3, n=2, hidden=(8,), layer_norm=False, discount=0.9))
    return tmp_path / "judged"


@pytest.mark.parametrize(
    ("words", "discount", "critics"),
    [([], 0.9, True), (["--option", "discount=0.5"], 0.5, True), (["--no-critics"], 0.99, False)],
)
def test_the_policys_critics_judge_what_follows_a_plan(
    words: list[str],
    discount: float,
    critics: bool,
    hopper_model: Path,
    judged: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "plan.json"
    main(envtf_plan(hopper_model, "--policy", str(judged), "--out", str(out), *words))
    found, said = json.loads(out.read_text()), capsys.readouterr().out
    assert (found["discount"], found["critics"]) == (discount, critics)
    assert f"discount {discount:g}." in said and ("critics judge what follows a plan" in said) == critics


def test_a_plan_is_worth_what_it_pays_and_the_value_of_its_end(hopper_model: Path, judged: Path):
    model, critics = load_world_model(hopper_model / "model"), load_critics(judged)
    words = ["horizon=3", "samples=8"]
    planner = planner_of("mppi", model, ROBOTS["hopper"], words, prior=critics.policy, critics=critics)
    observation = torch.zeros(2, 11) + torch.tensor([1.25] + [0.0] * 10)
    found = planner.search(observation)
    plans = planner.scaled(found.candidates)
    paths = imagined_paths(model, planner.state, plans)
    stands = ~ROBOTS["hopper"].terminated(paths[:, :, 1:]).any(-1)
    end = torch.where(stands, critics.value(paths[:, :, -1].flatten(0, 1)).view(2, -1), 0.0)
    paid = planner_of("mppi", model, ROBOTS["hopper"], [*words, "discount=0.9"])
    torch.testing.assert_close(found.returns, paid.objective.returns(planner.state, plans) + 0.9**3 * end)
    assert stands.any() and not stands.all()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--option", "horizon=0"], "horizon is 0, expected an integer, more than 0"),
        (["--option", "horizont=3"], "Unknown option 'horizont'.*did you mean 'horizon'"),
        (["--option", "horizon"], "write --option horizon=20"),
        (["--task", "walker2d-medium"], "observations of size 11.*walker2d has 17 and 6"),
        (["--world-model", "nowhere"], "nowhere"),
        (["--video", "x.gif"], "name them with --dataset"),
        (["--task", "Hoper-v5"], "no environment 'Hoper-v5': did you mean 'Hopper-v5'"),
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


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A robot of one's own, of four numbers and two unequal actuators: a log, its world model and a policy."""
    torch.manual_seed(0)
    limits = dict(action_low=np.array([-2, -1], np.float32), action_high=np.array([1, 3], np.float32))
    log = replace(dataset_of_chains(), **limits)
    save_dataset(log.with_split(0.3, 0), tmp_path / "log.h5")
    model = EnvironmentTransformer(4, 2, layers=1, heads=1, width=8, context=2)
    model.normaliser.target_mean[-1] = 0.5  # rewards that differ: else no plan is better than another
    save_world_model(tmp_path / "model", model)
    save_policy(tmp_path / "policy", TanhGaussianActor(4, 2, hidden=(8,), action_low=[-2, -1], action_high=[1, 3]))
    return tmp_path


def test_envtf_plan_plays_in_the_model_where_there_is_no_simulator(own: Path, capsys: pytest.CaptureFixture[str]):
    words = ["--dataset", str(own / "log.h5"), "--policy", str(own / "policy"), "--out", str(own / "plan.json")]
    few = ["--option", "horizon=2", "--option", "samples=4", "--episodes", "2", "--quiet", "--threads", "1"]
    main(["plan", "--world-model", str(own / "model"), *words, *few])
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(r"imagined return score steps.* mppi -?[\d.]+ – [1-4] .* policy -?[\d.]+ – [1-4] ", said)
    assert "opinion, which nobody measured" in said
    found = json.loads((own / "plan.json").read_text())
    assert found["task"] is None and len(found["returns"]) == len(found["prior_returns"]) == 2


def test_a_robot_without_a_simulator_is_planned_for_within_its_own_range_by_the_rule_of_its_log(own: Path):
    head = TerminationHead(4)
    torch.nn.init.constant_(cast(torch.nn.Linear, head.layers[-1]).bias, 9.0)  # to it, all states are falls
    save_termination(own / "model/termination", head)
    robot = robot_to_plan_for(own / "model", None, own / "log.h5")
    assert robot.max_episode_steps == 4 and robot.terminated(torch.zeros(1, 4)).all()
    planner = planner_of("random", load_world_model(own / "model"), robot, ["horizon=1", "samples=100"])
    first = planner.scaled(planner.search(torch.zeros(1, 4)).candidates)[0, :, 0]
    assert first.amin(0).tolist() == pytest.approx([-2, -1], abs=0.3)
    assert first.amax(0).tolist() == pytest.approx([1, 3], abs=0.3)
    played = score_planner(
        own / "model", robot, "random", ["horizon=1"], episodes=1, seed=0, steps=None, progress=False
    )
    assert played.planned.lengths.tolist() == [1]


def test_envtf_plan_plays_in_any_environment_of_gymnasium(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model = EnvironmentTransformer(3, 1, layers=1, heads=1, width=8, context=2)
    model.normaliser.target_mean[-1] = 0.5
    save_world_model(tmp_path / "model", model)
    few = ["--option", "horizon=2", "--option", "samples=4", "--steps", "3", "--quiet", "--threads", "1"]
    main(["plan", "--world-model", str(tmp_path / "model"), "--task", "Pendulum-v1", *few])
    assert re.search(r"mppi +-[\d.]+ +– +3 ", capsys.readouterr().out)


def test_a_policy_of_another_robot_is_refused(hopper_model: Path, tmp_path: Path):
    save_policy(tmp_path / "policy", TanhGaussianActor(17, 6, hidden=(8,)))
    with pytest.raises(UserError, match="policy of observations of size 17, and hopper has 11"):
        score_planner(hopper_model / "model", ROBOTS["hopper"], "mppi", policy=tmp_path / "policy", episodes=1, seed=0)


class Constant:
    """A learner with stable-baselines3's way to ask for actions, who always pushes alike."""

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
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
