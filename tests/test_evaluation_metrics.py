"""The keys and values of reports/metrics.json."""

import json

import numpy as np
import pytest
from analytic import linear_data, linear_world

from envtf_lit.data.cards import dataset_scores
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import collect_metrics, world_model_metrics
from envtf_lit.files import read_json, write_json
from envtf_lit.robots.returns import Episode, Returns
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.forecast import Scale, whole_episodes


def returns(values: list[float]) -> Returns:
    episode = Episode(0, np.zeros((2, 3)), np.zeros((1, 1)), np.zeros(1), np.zeros((2, 6)))
    array = np.array(values)
    scores = np.array([ROBOTS["hopper"].normalised_score(value) for value in values])
    return Returns(returns=array, lengths=np.ones(len(values)), scores=scores, median=episode)


def collect(source: str) -> dict:
    data, scale = linear_data((20, 30, 25), noise=0.05), Scale.of(linear_data((20, 30, 25), noise=0.05))
    report = horizon_report(linear_world(std=0.05), whole_episodes(data, 3, seed=0), scale)
    return collect_metrics(
        {"bc": returns([50.0]), "cql": returns([10.0, 20.0, 30.0]), "et_cql": returns([100.0, 300.0])},
        task="hopper-medium-replay",
        seed=7,
        dataset=data,
        source=source,
        robot=ROBOTS["hopper"],
        labels={"bc": "BC", "cql": "CQL", "et_cql": "ET + CQL"},
        world_model=world_model_metrics(report, scale, parameters=123),
        rollouts={"transitions": 456},
    )


@pytest.fixture(scope="module")
def metrics() -> dict:
    return collect("zoo")


def test_keys_are_exactly_those_promised(metrics):
    assert {name: set(value) if isinstance(value, dict) else None for name, value in metrics.items()} == {
        "task": None,
        "seed": None,
        "dataset": {"transitions", "episodes", "score_mean", "score_max"},
        "world_model": {
            "parameters",
            "nmse_one_step",
            "coverage_50",
            "coverage_90",
            "open_loop_steps_0.01",
            "teacher_forced_steps_0.01",
        },
        "rollouts": {"transitions"},
        "policies": {"bc", "cql", "et_cql"},
    }
    names = {"label", "score_mean", "score_std", "return_mean", "return_std", "episodes"}
    assert all(set(policy) == names for policy in metrics["policies"].values())


def test_values_survive_json_and_are_right(metrics, tmp_path):
    write_json(tmp_path / "metrics.json", metrics)
    assert read_json(tmp_path / "metrics.json") == metrics
    assert metrics["dataset"]["transitions"] == 75
    assert metrics["dataset"]["episodes"] == 3
    policy = metrics["policies"]["et_cql"]
    assert (policy["label"], policy["episodes"]) == ("ET + CQL", 2)
    assert (policy["return_mean"], policy["return_std"]) == (200.0, 100.0)
    assert policy["score_mean"] == pytest.approx(ROBOTS["hopper"].normalised_score(200.0))
    assert metrics["policies"]["cql"]["return_mean"] == 20.0
    assert metrics["policies"]["bc"]["score_std"] == 0.0
    assert 0.3 < metrics["world_model"]["coverage_50"] < 0.7


def test_minaris_data_are_never_set_beside_d4rls_scores():
    metrics = collect("minari")
    assert "score" not in json.dumps(metrics)
    data = linear_data((20, 30, 25), noise=0.05)
    assert metrics["dataset"] == {
        "transitions": 75,
        "episodes": 3,
        "return_mean": pytest.approx(data.episode_returns.mean()),
        "return_max": pytest.approx(data.episode_returns.max()),
    }
    policies = metrics["policies"]
    assert policies["et_cql"] == {"label": "ET + CQL", "return_mean": 200.0, "return_std": 100.0, "episodes": 2}
    assert policies["bc"] == {"label": "BC", "return_mean": 50.0, "return_std": 0.0, "episodes": 1}


def test_dataset_scores_are_those_of_its_episodes():
    data = linear_data((4, 6))
    expected = [ROBOTS["hopper"].normalised_score(float(data.rewards[a:b].sum())) for a, b in ((0, 4), (4, 10))]
    np.testing.assert_allclose(dataset_scores(data, ROBOTS["hopper"], "zoo"), expected, rtol=1e-5)
