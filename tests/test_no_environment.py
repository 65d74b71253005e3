"""A robot of the user's own, with no simulator: the whole pipeline, and what it may say of policies."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import linear_data, linear_world
from made_up_runs import said

from envtf_lit.agents.et_cql import ETCQLOptions, GuardedRolloutOptions
from envtf_lit.agents.value_gradient import ValueGradientOptions
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.offline import action_error, evaluate_offline, imagined_returns
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.evaluate import evaluate
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params, check_rules
from envtf_lit.pipeline.report import report
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.pipeline.yaml import preset_params
from envtf_lit.world_models.forecast import Scale, whole_episodes

# by hand


class Constant:
    """Always the same action."""

    def __init__(self, action: float) -> None:
        self.action = action

    def act(self, observation: torch.Tensor, deterministic: bool = True, generator=None) -> torch.Tensor:
        assert deterministic
        return torch.full((len(observation), 1), self.action)


def test_imagined_returns_follow_the_model_for_as_long_as_the_episode_lasted():
    data, world = linear_data((4, 9, 6)), linear_world(error=0.05)
    data = replace(data, rewards=data.rewards * 100)  # a range that does not cut anything
    held_out = whole_episodes(data, 3, seed=0)
    found = imagined_returns(world, Constant(0.5), held_out, data)
    for row, length in enumerate(held_out.lengths.tolist()):
        state, total = held_out.observations[row, 0], 0.0
        for _ in range(length):
            total += float(state.sum())
            state = world.matrix @ state + world.gain @ torch.tensor([0.5])
        assert found[row] == pytest.approx(total, rel=1e-4, abs=1e-5)


def test_imagined_rewards_never_leave_the_range_of_the_data():
    data, world = linear_data((4, 9, 6)), linear_world()
    world.matrix *= 1e9  # beyond what float32 holds after five steps
    held_out = whole_episodes(data, 3, seed=0)
    found = imagined_returns(world, Constant(0.5), held_out, data)
    assert np.isfinite(found).all()
    lengths = held_out.lengths.numpy()
    assert (found <= lengths * data.rewards.max() + 1e-6).all()
    assert (found >= lengths * data.rewards.min() - 1e-6).all()


def test_action_error_is_in_units_of_the_spread_of_the_actions():
    data = linear_data((40, 50))
    held_out = whole_episodes(data, 2, seed=0)
    mean = float(np.mean(data.actions))
    assert action_error(Constant(mean), held_out, data) == pytest.approx(1.0, rel=1e-4)
    wide = action_error(Constant(mean + 2 * float(np.std(data.actions))), held_out, data)
    assert wide == pytest.approx(5.0, rel=1e-4)


def test_a_perfect_model_gives_the_recorded_actions_their_true_return():
    data, world = linear_data((20, 30)), linear_world()
    report = horizon_report(world, whole_episodes(data, 2, seed=0), Scale.of(data))
    estimates = evaluate_offline(world, {"bc": Constant(0.0)}, report, data)
    np.testing.assert_allclose(estimates.imagined, estimates.recorded, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(sorted(estimates.recorded), sorted(data.episode_returns), rtol=1e-5)


# the pipeline


def own_log(episodes: int = 12, length: int = 25) -> OfflineDataset:
    """Five observations, two actions in [-2, 3]: a damped point, pushed about; every third episode terminates."""
    rng = np.random.default_rng(0)
    N = episodes * length
    observations, following = np.zeros((2, N, 5), np.float32)
    actions = rng.uniform(-2, 3, (N, 2)).astype(np.float32)
    push = rng.normal(size=(2, 5)) * 0.2
    for row in range(N):
        observations[row] = rng.normal(size=5) if row % length == 0 else following[row - 1]
        following[row] = 0.9 * observations[row] + actions[row] @ push + 0.01 * rng.normal(size=5)
    ends = np.arange(length - 1, N, length)
    terminated, truncated = np.zeros((2, N), bool)
    terminated[ends[::3]] = truncated[ends[1::3]] = truncated[ends[2::3]] = True
    return OfflineDataset(
        observations=observations,
        actions=actions,
        rewards=-np.square(following).sum(1).astype(np.float32),
        next_observations=following,
        terminated=terminated,
        truncated=truncated,
        episode_starts=np.arange(0, N, length),
        action_low=np.full(2, -2, np.float32),
        action_high=np.full(2, 3, np.float32),
        task="hopper-medium",  # which the user's null must override
    )


def own_params(path: Path) -> Params:
    tiny = preset_params("tiny")
    policies = {name: replace(options, updates=40, updates_per_epoch=20) for name, options in tiny.train_policy.items()}
    assert isinstance(policies["et_cql"], ETCQLOptions)
    policies["et_cql"] = replace(
        policies["et_cql"],
        critic_updates=15,
        rollouts=GuardedRolloutOptions(history=2),
        value_gradient=ValueGradientOptions(updates=5, rollouts=5, horizon=3),
    )
    return replace(
        tiny,
        task=None,
        threads=1,
        download=DownloadOptions(source="file", path=str(path), held_out=0.25),
        generate_rollouts=replace(tiny.generate_rollouts, branches=30),
        train_policy=policies,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Params]:
    """A project in which every stage up to `evaluate` has run on a log of the user's own."""
    root = tmp_path_factory.mktemp("own")
    save_dataset(replace(own_log(), task=None), root / "log.npz")
    params = own_params(root / "log.npz")
    check_rules(params)
    download(params, root, progress=False)
    train_model(params, root, progress=False)
    train_policy(params, root, name="bc", progress=False)
    generate_rollouts(params, root, progress=False)
    for name in ("cql", "et_cql"):
        train_policy(params, root, name=name, progress=False)
    evaluate(params, root, progress=False)
    return root, params


def test_metrics_hold_no_score_and_only_finite_numbers(finished: tuple[Path, Params]):
    root, _ = finished
    metrics = json.loads((root / "reports/metrics.json").read_text(), parse_constant=pytest.fail)
    assert metrics["task"] is None
    assert "score" not in json.dumps(metrics)
    assert set(metrics["policies"]) == {"bc", "cql", "et_cql"}
    assert {name: policy["world_model"] for name, policy in metrics["policies"].items()} == {
        "bc": None,
        "cql": None,
        "et_cql": "transformer",
    }
    names = {
        "label",
        "algorithm",
        "world_model",
        "imagined_return_mean",
        "imagined_return_std",
        "action_error",
        "effective_episodes",
    }
    assert all(set(policy) == names for policy in metrics["policies"].values())
    assert metrics["held_out"]["episodes"] == 2  # of the three held out, one scales the predicted intervals
    assert metrics["policies"]["bc"]["action_error"] > 0
    assert all(policy["effective_episodes"] > 1 for policy in metrics["policies"].values())
    assert metrics["world_model"]["termination"] == "learned"
    card = json.loads((root / "data/dataset.json").read_text())
    assert card["task"] is None and "scores" not in card


def test_policies_never_saw_the_held_out_episodes_and_act_in_the_files_own_range(finished: tuple[Path, Params]):
    from envtf_lit.policy import load_policy

    root, _ = finished
    dataset = load_dataset(root / "data/dataset.h5")
    training, held_out = dataset.split()
    assert len(held_out.episode_starts) == 3
    for name in ("bc", "cql", "et_cql"):
        policy = load_policy(root / "models/policy" / name)
        mean, _ = training.observation_scale()
        torch.testing.assert_close(policy.observation_mean, mean)
        assert policy.action_low.tolist() == [-2, -2]
        assert policy.action_high.tolist() == [3, 3]


def test_there_are_plots_and_in_place_of_the_video_a_sentence(finished: tuple[Path, Params]):
    root, _ = finished
    assert "no simulator" in (root / "reports/video/none.txt").read_text()
    plots = {path.name for path in (root / "reports/plots").iterdir()}
    assert {"scores.png", "horizon.png", "calibration.png", "policy_curves.png", "traces.png"} <= plots


def test_the_report_says_that_nobody_measured_a_return(finished: tuple[Path, Params], repository: Path):
    root, params = finished
    (root / "notebooks").mkdir()
    name = "notebooks/report_offline.ipynb"
    (root / name).write_bytes((repository / name).read_bytes())
    report(params, root, progress=False)
    text = said(root / "reports/report.ipynb")
    assert "Only the robot can tell" in text
    assert "a classifier learned from the log says so" in text
    assert "No video" in text
    assert "D4RL" not in text and "hop" not in text.lower()


def test_a_null_task_overrides_the_files(tmp_path: Path):
    log = own_log()
    wide = replace(log, observations=np.zeros((300, 11), np.float32), next_observations=np.zeros((300, 11), np.float32),
                   actions=np.zeros((300, 3), np.float32), action_low=-np.ones(3), action_high=np.ones(3))  # fmt: skip
    save_dataset(wide, tmp_path / "log.h5")
    download(own_params(tmp_path / "log.h5"), tmp_path, progress=False)
    assert load_dataset(tmp_path / "log.h5").task == "hopper-medium"
    assert load_dataset(tmp_path / "data/dataset.h5").task is None


def test_a_null_task_needs_data_of_ones_own():
    with pytest.raises(UserError, match="which has our robots' data alone"):
        check_rules(replace(preset_params("tiny"), task=None))
