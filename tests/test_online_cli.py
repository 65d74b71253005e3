"""`envtf agent fit --data.source online`: who acts when, what is learned from, and runs that go on to the same bits."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from envtf_lit import load_policy
from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.cql import CQL
from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.files import read_json
from envtf_lit.policy import RandomPolicy
from envtf_lit.robots.environments import robot_in
from envtf_lit.robots.returns import evaluate_policy
from tests.lightning_runs import NO_LOGGER, QUIET, named
from tests.walker import walker_dataset

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")

PENDULUM = ["--data.environment=Pendulum-v1", "--model.options.warm_start=0"]
LOG = ["--data.path=data/dataset.h5"]
SMALL = {"hidden": [8], "batch_size": 8, "updates": 40, "updates_per_epoch": 20, "warm_start": 10}
FEW = ["--data.first_steps=30", "--data.evaluation_episodes=1"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a dataset of Hopper's dimensions, and the current folder."""
    save_dataset(walker_dataset(), tmp_path / "data/dataset.h5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fit(*flags: str, **options: object) -> dict[str, np.ndarray]:
    """Learns online; the curves of what it published, by column."""
    shutil.rmtree(".envtf/published", ignore_errors=True)
    main(["agent", "fit", "--config=online", NO_LOGGER, *QUIET, *FEW, *named(SMALL | options), *flags])
    curves = pd.read_csv(".envtf/published/curves.csv")
    return {name: np.asarray(curves[name]) for name in curves}


def refused(capsys: pytest.CaptureFixture[str], *flags: str, verb: str = "fit", **options: object) -> str:
    """The one sentence with which it ends in status 2."""
    with pytest.raises(SystemExit) as stop:
        main(["agent", verb, "--config=online", NO_LOGGER, *QUIET, *FEW, *named(SMALL | options), *flags])
    said = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2 and "Traceback" not in "\n".join(said)
    return said[-1]


@pytest.mark.parametrize("algorithm", ["sac", "cql", "td3_bc", "rebrac", "iql"])
def test_an_algorithm_with_critics_learns_from_what_it_lives_through(algorithm: str, folder: Path) -> None:
    curves = fit(*LOG, f"--model.algorithm={algorithm}")
    assert curves["epoch"].tolist() == [0, 1, 2]
    assert curves["train/env_steps"].tolist()[1:] == [30 + 10, 30 + 30]  # nobody acts in ten updates' warm start
    assert np.isfinite(curves["val/return"]).all() and np.isfinite(curves["train/bellman_loss"][1:]).all()


def test_what_is_published_is_what_was_evaluated(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    curves = fit(*PENDULUM, "--data.evaluation_episodes=2", "--model.seed=3")
    assert ".envtf/published" in capsys.readouterr().out
    policy, robot = load_policy(".envtf/published"), robot_in("Pendulum-v1")
    assert (policy.action_low.tolist(), policy.action_high.tolist()) == ([-2.0], [2.0])
    reached = evaluate_policy(policy, robot, episodes=2, seed=3, progress=False).returns.mean()
    assert curves["val/return"][-1] == pytest.approx(reached)
    assert read_json(".envtf/published/metrics.json")["return"] == pytest.approx(reached)
    assert "val/score" not in curves  # nobody says what a random and an expert pendulum return


def test_a_robots_score_is_d4rls_and_the_curve_begins_where_the_policy_did(folder: Path) -> None:
    fit(*LOG)
    Path(".envtf/published").rename("first")
    curves = fit(*LOG, "--model.init_from=first", warm_start=0)
    hopper = robot_in("hopper")
    began = evaluate_policy(load_policy("first"), hopper, episodes=1, seed=0, progress=False)
    assert curves["val/return"][0] == pytest.approx(began.returns.mean(), rel=1e-3)  # the scales are the log's again
    np.testing.assert_allclose(curves["val/score"], [hopper.normalised_score(r) for r in curves["val/return"]])


@pytest.mark.parametrize(("ratio", "acted"), [(0.5, 80), (2.0, 20), (7.0, 6)])
def test_so_many_updates_follow_each_step(ratio: float, acted: int, folder: Path) -> None:
    flags = [*PENDULUM, f"--data.updates_per_env_step={ratio}", "--data.evaluation_episodes=0"]
    curves = fit(*flags)
    assert curves["train/env_steps"][-1] == 30 + acted
    assert fit(*flags, "--data.environments=3")["train/env_steps"][-1] == -(-(30 + acted) // 3) * 3


def seen_by(monkeypatch: pytest.MonkeyPatch, cls: Any) -> list[dict[str, torch.Tensor]]:
    """The batches that an agent's updates are given."""
    seen, update = list[dict[str, torch.Tensor]](), cls.update
    monkeypatch.setattr(cls, "update", lambda self, batch: seen.append(batch) or update(self, batch))
    return seen


@pytest.mark.parametrize(("share", "expected"), [(0.5, 4), (0.25, 2), (0.0, 0)])
def test_a_share_of_each_batch_is_of_the_log_and_in_the_warm_start_all(
    share: float, expected: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = seen_by(monkeypatch, ActorCritic)
    fit(*LOG, f"--data.log_share={share}")
    log = torch.from_numpy(np.asarray(load_dataset("data/dataset.h5").observations))
    logged = [(batch["observations"][:, None] == log).all(-1).any(-1) for batch in seen]
    assert all(rows.all() for rows in logged[:10])
    assert all(rows.tolist() == [True] * expected + [False] * (8 - expected) for rows in logged[10:])


def test_the_first_steps_are_the_actors_where_there_is_a_log_and_random_where_there_is_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random, act = list[int](), RandomPolicy.act
    monkeypatch.setattr(RandomPolicy, "act", lambda *given, **named: random.append(1) or act(*given, **named))
    fit(*LOG)
    assert not random
    curves = fit(*PENDULUM)
    assert len(random) == 30 and curves["train/env_steps"][-1] == 30 + 40


def test_values_may_be_as_large_as_the_rewards_that_were_met_allow(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = load_dataset("data/dataset.h5")
    log.rewards[:] *= 1e-3  # whose bound Hopper's rewards of about one would pass
    save_dataset(log, "data/dataset.h5")
    allowed, end = list[float](), CQL.on_train_epoch_end
    monkeypatch.setattr(
        CQL, "on_train_epoch_end", lambda self: allowed.append(self.log_returns.largest) or end(self), raising=False
    )
    fit(*LOG, "--model.algorithm=cql")
    assert allowed[0] > 1.0 / (1.0 - 0.99) / 2 > 100 * float(log.rewards.max())


# runs that go on


def written() -> dict[str, bytes]:
    """Every file that was published, critics among them."""
    return {str(path): path.read_bytes() for path in sorted(Path(".envtf/published").rglob("*")) if path.is_file()}


CASES = {
    "from nothing": ([*PENDULUM, "--data.environments=2"], {}),
    "beside a log": (LOG, {"n_step": 3}),
    "killed in the warm start": (LOG, {"warm_start": 30}),
    "deterministic": ([*LOG, "--model.algorithm=td3_bc", "--data.replay_rows=40"], {}),
}


@pytest.mark.parametrize(("flags", "options"), CASES.values(), ids=CASES.keys())
def test_a_continued_run_equals_an_uninterrupted_one(
    flags: Sequence[str], options: dict[str, Any], folder: Path
) -> None:
    fit(*flags, "--trainer.max_epochs=1", **options)
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    shutil.rmtree(".envtf/published")
    plain = [flag for flag in flags if not flag.startswith("--model.options")]
    main(["agent", "fit", "--data.source=online", NO_LOGGER, *QUIET, *FEW, f"--ckpt_path={checkpoint}", *plain])
    resumed = written()
    fit(*flags, **options)
    assert written() == resumed
    assert len(pd.read_csv(".envtf/published/curves.csv")) == 3


def test_a_run_on_a_log_goes_on_online_with_its_critics(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    offline = {**SMALL, "warm_start": 0.5}
    main(["agent", "fit", "--data.path=data/dataset.h5", NO_LOGGER, *QUIET, *named(offline)])
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    shutil.rmtree(".envtf/published")
    onward = ["agent", "fit", NO_LOGGER, *QUIET, *LOG, "--model.options.updates=60", "--data.source=online", *FEW]
    main([*onward, f"--ckpt_path={checkpoint}"])
    curves = pd.read_csv(".envtf/published/curves.csv")
    assert curves["epoch"].tolist() == [1, 2, 3]
    assert curves["train/env_steps"].tolist()[2] == 30 + 20  # the updates on the log alone count for none
    (later,) = set(Path(".envtf").rglob("*.ckpt")) - {checkpoint}
    with pytest.raises(SystemExit):
        main(["agent", "fit", NO_LOGGER, *QUIET, *LOG, f"--ckpt_path={later}"])
    assert "is of a run that learns online: add --data.source online" in capsys.readouterr().err


# what is refused


def test_what_cannot_learn_online_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for algorithm, label in (("bc", "BC"), ("wbc", "Weighted BC")):
        said = refused(capsys, *LOG, f"--model.algorithm={algorithm}")
        assert f"{label} imitates a log and learns nothing from rewards of its own" in said
    assert "mopo needs a world model" in refused(capsys, *LOG, "--model.algorithm=mopo")
    said = refused(capsys, *PENDULUM, "--model.options.warm_start=0.5")
    assert "model.options.warm_start is 0.5, and there is no log to warm up on" in said
    assert "give --data.environment a robot such as hopper" in refused(capsys)
    assert "did you mean 'Pendulum-v1'" in refused(capsys, "--data.environment=Pendulm-v1")
    assert "--data.source is 'onlin': did you mean 'online'?" in refused(capsys, "--data.source=onlin")
    assert "`envtf agent validate` looks at a log's rows" in refused(capsys, *LOG, verb="validate")
    said = refused(capsys, *LOG, "--data.environment=ant")
    assert "log has 11 observations and 3 actions, and Ant-v5 has 27 and 8" in said
    assert not Path(".envtf/published").exists()


def test_another_environment_than_the_logs_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit(*LOG, "--data.environment=Hopper-v4", "--data.evaluation_episodes=0")
    assert "is not the log's: the log is of Hopper-v5, this is Hopper-v4." in capsys.readouterr().err
