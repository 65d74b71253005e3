"""Training the zoo's policies: weights that act as the learner's do, and a series that the zoo reads."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import ROBOTS, get_task
from envtf_lit.zoo import train as behaviour_training
from envtf_lit.zoo.collect import collect
from envtf_lit.zoo.snapshots import ZOO, Series, load_snapshot, read_series
from envtf_lit.zoo.train import RECIPES, RENORM_EPSILON, _stretch, average_last_snapshots, flax_to_torch, train

HOPPER = ROBOTS["hopper"]


@pytest.mark.parametrize("normalised", [False, True])
def test_flax_weights_give_the_same_actor(normalised: bool) -> None:
    """Against sbx's actor written out: normalisation before each layer, ReLU after the hidden ones."""
    random = np.random.default_rng(0)
    sizes = {"Dense_0": (11, 16), "Dense_1": (16, 16), "Dense_2": (16, 3), "Dense_3": (16, 3)}
    params = {k: {"kernel": random.normal(size=v) / 4, "bias": random.normal(size=v[1])} for k, v in sizes.items()}
    widths = {"BatchRenorm_0": 11, "BatchRenorm_1": 16, "BatchRenorm_2": 16}
    norms = {k: {"scale": random.normal(size=n), "bias": random.normal(size=n)} for k, n in widths.items()}
    statistics = {k: {"mean": random.normal(size=n), "var": random.uniform(0.1, 4, size=n)} for k, n in widths.items()}

    def normalise(x: np.ndarray, index: int) -> np.ndarray:
        if not normalised:
            return x
        norm, running = norms[f"BatchRenorm_{index}"], statistics[f"BatchRenorm_{index}"]
        return norm["scale"] * (x - running["mean"]) / np.sqrt(running["var"] + RENORM_EPSILON) + norm["bias"]

    observation = random.normal(size=(5, 11))
    x = observation
    for index in (0, 1):
        layer = params[f"Dense_{index}"]
        x = np.maximum(normalise(x, index) @ layer["kernel"] + layer["bias"], 0)
    x = normalise(x, 2)
    expected = [x @ params[head]["kernel"] + params[head]["bias"] for head in ("Dense_2", "Dense_3")]
    actor = TanhGaussianActor(11, 3, hidden=[16, 16], log_std_min=-20.0)
    weights = flax_to_torch(params | norms, statistics) if normalised else flax_to_torch({"params": params}, None)
    actor.load_state_dict(actor.state_dict() | weights)
    mean, log_std = actor(torch.tensor(observation, dtype=torch.float32))
    np.testing.assert_allclose(mean.detach(), expected[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(log_std.detach(), expected[1].clip(-20, 2), rtol=1e-4, atol=1e-4)


def test_snapshots_follow_the_warm_up_and_lie_closer_at_the_start() -> None:
    steps = [0]
    while steps[-1] < 150_000:
        steps.append(steps[-1] + _stretch(steps[-1]))
    assert steps[1] == 7_500  # none before the warm-up has ended
    assert set(range(10_000, 25_001, 2_500)) | set(range(30_000, 50_001, 5_000)) <= set(steps)
    assert steps[-8:] == [50_000, 60_000, 70_000, 80_000, 90_000, 100_000, 125_000, 150_000]


def test_a_missing_sbx_is_named_with_its_cure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "sbx", None)
    with pytest.raises(UserError, match=r"needs sbx-rl .*pip install 'envtf-lit\[behaviour\]'"):
        train(HOPPER, tmp_path, algorithm="sac", steps=6_000, seed=0, progress=False)
    assert not list(tmp_path.iterdir())


def test_a_series_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hopper").mkdir()
    with pytest.raises(SystemExit) as stop:
        main(["zoo", "train", "--robot", "hopper", "--out", str(tmp_path)])
    assert stop.value.code == 2
    assert "exists already" in capsys.readouterr().err
    with pytest.raises(UserError, match="100 steps are no training"):
        train(ROBOTS["ant"], tmp_path, algorithm="sac", steps=100, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", RECIPES)
def test_a_short_training_leaves_a_series_that_makes_datasets(algorithm: str, tmp_path: Path) -> None:
    pytest.importorskip("sbx", reason="the extra `behaviour` is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(behaviour_training, "EPISODES", 2)
        main(["zoo", "train", "--robot", "hopper", "--out", str(tmp_path), "--algorithm", algorithm,
              "--steps", "8000", "--quiet"])  # fmt: skip
    series = read_series(HOPPER, tmp_path)
    assert series.warm_up_steps == 5_000
    assert [round(snapshot.steps, -2) for snapshot in series.snapshots] == [7_500, 8_000]
    assert RECIPES[algorithm].algorithm in series.trained_with
    dataset = collect(get_task("hopper-medium"), 100, seed=0, workers=1, zoo=tmp_path, progress=False)
    assert len(dataset) == 100


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", RECIPES)
def test_our_actor_acts_as_the_learners(algorithm: str) -> None:
    pytest.importorskip("sbx", reason="the extra `behaviour` is not installed")
    learner = behaviour_training._learner(HOPPER, RECIPES[algorithm], seed=0)
    learner.learning_starts = 256
    learner.learn(800)
    observation = np.random.default_rng(0).normal(size=(64, 11)).astype(np.float32)
    theirs, _ = learner.predict(observation, deterministic=True)
    ours = behaviour_training._actor(HOPPER, learner).act(torch.from_numpy(observation))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


def _last_layer(series: Series, steps: int) -> torch.nn.Linear:
    layer = load_snapshot(series, steps).net[-1]
    assert isinstance(layer, torch.nn.Linear)
    return layer


def test_settling_averages_the_late_snapshots_and_calms_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(behaviour_training, "EPISODES", 1)
    shutil.copytree(ZOO / "hopper", tmp_path / "hopper")
    before = read_series(HOPPER, tmp_path)
    late = [_last_layer(before, snapshot.steps) for snapshot in before.snapshots[-2:]]
    main(["zoo", "settle", "--robot", "hopper", "--out", str(tmp_path), "--last", "2", "--noise", "0.25"])
    assert "The last snapshot now returns" in capsys.readouterr().out
    after = read_series(HOPPER, tmp_path)
    assert after.snapshots[:-1] == before.snapshots[:-1]
    assert after.trained_with.endswith("the mean of the last 2's weights, with 0.25 times the standard deviation")
    layer = _last_layer(after, after.snapshots[-1].steps)
    torch.testing.assert_close(layer.weight, (late[0].weight + late[1].weight) / 2)
    log_std = (late[0].bias + late[1].bias)[3:] / 2 + np.log(0.25)
    torch.testing.assert_close(layer.bias[3:], log_std)
    with pytest.raises(UserError, match="settled before"):
        average_last_snapshots(HOPPER, tmp_path)


def test_settling_that_is_interrupted_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(behaviour_training, "EPISODES", 1)
    shutil.copytree(ZOO / "hopper", tmp_path / "hopper")
    before = {path.name: path.read_bytes() for path in (tmp_path / "hopper").iterdir()}

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(behaviour_training, "write_json", interrupt)
    with pytest.raises(KeyboardInterrupt):
        average_last_snapshots(HOPPER, tmp_path)
    assert {path.name: path.read_bytes() for path in (tmp_path / "hopper").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["hopper"]


@pytest.mark.parametrize(("last", "noise"), [(0, 0.5), (1_000, 0.5), (3, 0.0)])
def test_settling_refuses_what_cannot_be(tmp_path: Path, last: int, noise: float) -> None:
    shutil.copytree(ZOO / "hopper", tmp_path / "hopper")
    with pytest.raises(UserError, match="has 19 snapshots"):
        average_last_snapshots(HOPPER, tmp_path, last=last, noise=noise)
