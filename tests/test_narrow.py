"""Logs of machines that were held back, their true simulators, and the study of what is learned from them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.studies import LOGS, Log
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.yaml import preset_params
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.studies import narrow
from envtf_lit.studies.narrow import NarrowOptions, page, run_narrow
from envtf_lit.studies.narrow_logs import BEYOND, FIRST_SEED, MACHINES, RUIN, driver, make_log, simulator

STEP = 0.05  # seconds of HalfCheetah's


def short(name: str, **changes: Any) -> tuple[OfflineDataset, float]:
    """The first three episodes, of 120 steps."""
    return make_log(replace(MACHINES[name], **changes), episodes=3, steps=120)


@pytest.fixture(scope="module")
def governed() -> tuple[OfflineDataset, float]:
    return short("governed")


def speeds(log: OfflineDataset) -> np.ndarray:
    """m/s of each step, by the odometer."""
    return (log.next_observations[:, 0] - log.observations[:, 0]) / STEP


# the logs


@pytest.mark.parametrize(("speed", "share"), [(-20.0, 1.0), (2.5, 0.6), (20.0, 0.2)])
def test_the_governor_lets_actions_fade_to_a_fifth(speed: float, share: float):
    """Without the actions' limits, which come after it."""
    machine, seen = replace(MACHINES["governed"], gain=1.0), torch.zeros(1, 18)
    seen[0, 9] = speed
    bare = driver(replace(machine, governor=None), eager=False)(seen)
    torch.testing.assert_close(driver(machine, eager=False)(seen), share * bare)
    assert driver(machine, eager=True)(seen).abs().sum() >= driver(machine, eager=False)(seen).abs().sum()


def test_the_governor_holds_the_machine_back(governed):
    slow, _ = short("governed", governor=0.5)
    assert speeds(slow)[60:120].mean() < 0.8 * speeds(governed[0])[60:120].mean()


def test_actions_are_saturated(governed):
    mild, _ = short("governed", gain=1.0)
    shares = [(np.abs(log.actions) == 1.0).mean() for log in (governed[0], mild)]
    assert shares[0] > 0.15 and shares[1] < 0.5 * shares[0]


def test_the_odometer_counts_and_so_does_the_clock(governed):
    log, limit = governed
    assert log.observation_dim == 18
    starts = log.episode_starts
    assert np.abs(log.observations[starts, 0]).max() < 0.2 and log.observations[starts + 119, 0].min() > 5.0
    assert speeds(log).max() == pytest.approx(limit / BEYOND, rel=1e-3)
    clock, _ = short("clock")
    assert clock.observation_dim == 18
    assert clock.observations[:, -1].tolist() == [*range(120)] * 3
    assert clock.next_observations[:, -1].tolist() == [*range(1, 121)] * 3


def test_ruin_lies_just_beyond_the_fastest_step_and_the_log_never_shows_it(governed):
    log, limit = governed
    assert log.rewards.min() > RUIN and log.task is None
    for speed, ruined in ((limit, 0), (limit / BEYOND * 0.9999, 1)):
        env = simulator(MACHINES["governed"], speed).make()
        rewards = []
        for episode, start in enumerate(log.episode_starts):
            env.reset(seed=FIRST_SEED + episode)
            rewards += [env.step(action)[1] for action in log.actions[start : start + 120]]
        env.close()
        found = np.array(rewards) == RUIN
        assert found.sum() == ruined
        np.testing.assert_allclose(np.array(rewards)[~found], log.rewards[~found], rtol=1e-5, atol=1e-5)


def test_the_handed_log_is_made_anew():
    """Returns of its first episodes: 3,001 and 2,851 of a mean of 2,830, under MuJoCo 4."""
    log, limit = make_log(MACHINES["governed"], episodes=2)
    assert log.episode_returns == pytest.approx([3001, 2851], rel=0.05)
    assert limit == pytest.approx(4.38, rel=0.1)
    assert log.truncated.sum() == 2 and not log.terminated.any()


@pytest.mark.parametrize("name", MACHINES)
def test_every_log_is_narrow_and_fits_its_simulator(name: str):
    log, limit = short(name)
    robot = simulator(MACHINES[name], limit)
    assert (robot.observation_dim, robot.action_dim) == (log.observation_dim, log.action_dim)
    assert robot.env_id == ROBOTS[MACHINES[name].robot].env_id
    assert len(log) == 360 and not log.terminated.any()
    assert np.isfinite(limit) and (log.action_low == -1).all() and (log.action_high == 1).all()
    policy = TanhGaussianActor(robot.observation_dim, robot.action_dim, hidden=(8,))
    found = evaluate_policy(policy, replace(robot, max_episode_steps=5), episodes=2, seed=0, progress=False)
    assert found.median.observations.shape == (6, log.observation_dim)


def test_the_command_knows_every_log():
    assert set(LOGS) == set(get_args(Log)) == set(MACHINES)


# the study


def finding(**changes: Any) -> dict[str, Any]:
    found: dict[str, Any] = dict(
        return_mean=2800.0, return_std=20.0, clone_return_mean=2850.0, promised_low=2000.0, promised_high=3000.0,
        promise_held=True, update=0, excess=0.0, of_recorded=0.99, of_clone=0.98, harmless=True,
    )  # fmt: skip
    return found | changes


def test_the_table_names_the_worst_seed_and_calls_harm_harm():
    seeds = [finding(), finding(of_recorded=0.7, harmless=False, promise_held=False, update=300, excess=0.12)]
    result: dict[str, Any] = {"governed.recorded_mean": 2830.0, "governed.speed_limit": 4.4, "plain.recorded_mean": 1.0}
    for seed, found in enumerate(seeds):
        result |= {f"governed.seed_{seed}.{key}": value for key, value in found.items()}
    text = page(result)
    assert "| governed | 2,830 | 2 | 84%, 70% | 98%, 98% | 1 of 2 | 1 of 2 |" in text
    assert "| governed | 0 | 2,800 ± 20 | 99% | 98% | 2,000 to 3,000 | yes | the clone |" in text
    assert "| 98% **harm** |" in text and "| **no** | after update 300, 0.12 nats |" in text
    assert "plain" not in text  # of which no seed is done
    widths = {block: {line.count("|") for line in block.splitlines()} for block in text.strip().split("\n\n")}
    assert all(len(found) == 1 for found in widths.values())


@pytest.mark.parametrize(("earned", "reference", "enough"), [(80, 100, True), (79, 100, False), (-110, -100, True)])
def test_harm_is_what_is_lost_of_returns_of_either_sign(earned: float, reference: float, enough: bool):
    assert narrow._enough(earned, reference, narrow.OF_RECORDED) is enough


def test_options_that_know_no_trust_are_refused(tmp_path: Path):
    params = preset_params("paper")
    with pytest.raises(UserError, match=r"train_policy\.et_cql does not know trust"):
        run_narrow(tmp_path / "n.json", params=params, options=NarrowOptions())


@pytest.mark.slow
def test_a_study_from_end_to_end_and_what_is_finished_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two seeds on a log of six episodes of 60 steps, with networks that hardly learn."""
    tiny = replace(preset_params("tiny"), threads=1)
    out, lines = tmp_path / "narrow.json", list[str]()
    options = NarrowOptions(seeds=1, episodes=2, recorded=6, steps=60)
    common: dict[str, Any] = dict(
        params=tiny, machines={"clock": MACHINES["clock"]}, work=tmp_path / "work", progress=False, report=lines.append
    )
    first = run_narrow(out, options=options, **common)
    assert json.loads(out.read_text()) == first
    found = {key.removeprefix("clock.seed_0."): value for key, value in first.items() if ".seed_0." in key}
    assert found.keys() == finding().keys()
    assert found["promised_low"] <= found["promised_high"]
    assert found["of_recorded"] == pytest.approx(found["return_mean"] / first["clock.recorded_mean"])
    if found["update"] == 0:
        assert found["return_mean"] == found["clone_return_mean"]
    assert "| clock | 0 |" in out.with_suffix(".md").read_text() and len(lines) == 1

    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").rglob("*.safetensors")}
    monkeypatch.setattr(narrow, "train_model", pytest.fail)
    second = run_narrow(out, options=replace(options, seeds=2), **common)
    same = {key: value for key, value in first.items() if not key.startswith(("computer.", "narrow.seeds"))}
    assert same.items() <= second.items()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert second["clock.seed_1.return_mean"] != first["clock.seed_0.return_mean"]
