"""`envtf bench`: the keys that others read, on budgets of seconds, and what the figures rest on."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from envtf_lit.cli.main import main
from envtf_lit.cli.signatures import parse_words
from envtf_lit.cli.studies import bench_cost as bench_cost_command
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.studies import agent_speed
from envtf_lit.studies.agent_speed import OPTIONS, bench_agents, their_side
from envtf_lit.studies.cost import _plain, bench_cost
from envtf_lit.studies.machine import in_turns, ratio, typical
from envtf_lit.studies.speed import _training, bench_model
from envtf_lit.studies.suite import SuiteOptions
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions
from envtf_lit.world_models.transformer import EnvironmentTransformer

RATIOS = (
    "imagined_per_second",
    "ratio_vs_ensemble_short",
    "ratio_vs_ensemble_full",
    "ratio_vs_hopper",
    "ratio_vs_uncached",
    "train_fraction_of_matmul_peak",
)


def test_the_speed_file_is_flat_and_has_the_named_keys(tmp_path: Path) -> None:
    out = tmp_path / "model.json"
    result = bench_model(
        out,
        preset="tiny",
        device="cpu",
        batch=16,
        horizon=2,
        rounds=1,
        real_steps=20,
        updates=1,
        threads=1,
        precision="fp32",
    )
    assert json.loads(out.read_text()) == result
    assert all(isinstance(result[name], float) and result[name] > 0 for name in RATIOS)
    assert not any(isinstance(value, dict | list) for value in result.values())
    assert {"device", "threads", "precision", "torch", "mujoco", "load_average", "seed"} <= result.keys()


def test_the_agents_speed_is_measured_without_d3rlpy_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(agent_speed.NETS, "hidden", (8, 8, 8))
    monkeypatch.setitem(agent_speed.NETS, "batch_size", 8)
    monkeypatch.setitem(agent_speed.COST, "cql", 1)
    out = tmp_path / "agents.json"
    result = bench_agents(out, updates=10, rounds=1)
    assert json.loads(out.read_text()) == result
    against = [name for name in result if "_vs_d3rlpy" in name]
    assert len(against) == 8 and all(result[name] is None for name in against)
    rates = [result[f"{name}_{one}_updates_per_second"] for name in OPTIONS for one in ("fp32", "bf16")]
    assert min(*rates, result["default_updates_per_second"], result["stacked_seeds_ratio"]) > 0
    assert result["lightning_share"] < 1


def test_a_python_without_d3rlpy_is_refused(tmp_path: Path) -> None:
    for python, words in ((tmp_path / "python", "cannot be run"), (Path(sys.executable), "has no d3rlpy")):
        with pytest.raises(UserError, match=words), their_side(python, tmp_path / "log.npz", 1):
            pass


def test_an_odd_number_of_updates_is_refused() -> None:
    with pytest.raises(UserError, match="--updates is 30: take a multiple of 100"):
        bench_agents(updates=30)


def test_rounds_take_turns_and_the_first_warms_up() -> None:
    order, ticks = [], iter([100.0, 1.0, 2.0, 4.0, 3.0, 3.0, 10.0, 1.0])
    action = lambda name: lambda: order.append(name) or next(ticks)  # noqa: E731
    rounds = in_turns({"a": action("a"), "b": action("b")}, 3)
    assert order == ["a", "b"] * 4
    assert typical(rounds, "a") == 3.0 and typical(rounds, "b") == 3.0
    assert ratio(rounds, "b", "a") == 1.0  # of 2, 1 and a tenth: each round's own


def test_a_token_costs_six_operations_for_each_weight_of_a_matrix() -> None:
    options = TransformerOptions(layers=1, heads=1, width=8, context=4, batch_size=2)
    _, flops = _training(ROBOTS["hopper"], options, torch.device("cpu"), "fp32", 1, compile=False)
    embed, attention, mlp, head = 14 * 8, 4 * 8 * 8, 2 * 4 * 8 * 8, 8 * 2 * 12
    assert flops == 6 * (embed + attention + mlp + head)


def test_an_unknown_device_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["bench", "model", "--device", "abacus"])
    assert stop.value.code == 2 and "No device 'abacus' here" in capsys.readouterr().err


def test_a_suites_budgets_come_from_the_command_line() -> None:
    def parse(*flags: str) -> SuiteOptions:
        return parse_words(bench_cost_command, "bench cost", flags)[1]["training"].options()

    assert parse("--threads", "2") == SuiteOptions()
    options = parse("--updates", "20", "--ensemble-updates", "30", "--threads", "1")
    assert (options.updates, options.ensemble.updates, options.ensemble.updates_per_epoch) == (20, 30, 30)


def test_the_plain_network_has_the_transformers_parameters() -> None:
    train = _plain(TransformerOptions(), EnsembleOptions(), 11, 3)
    assert train.members == 1
    plain = EnsembleDynamics(11, 3, members=1, elites=1, hidden=train.hidden)
    transformer = EnvironmentTransformer(11, 3)
    sizes = [sum(p.numel() for p in model.parameters()) for model in (plain, transformer)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.01)


@pytest.mark.slow
def test_cost_is_counted_to_an_error_that_all_reach(tmp_path: Path) -> None:
    ensemble = EnsembleOptions(
        members=3, elites=2, hidden=(8,), weight_decay=(0, 0), updates=6, updates_per_epoch=2, batch_size=8
    )
    options = SuiteOptions(transitions=1_000, updates=2, context=4, ensemble=ensemble, threads=1)
    out, models = tmp_path / "cost.json", ("transformer", "ensemble")
    result = bench_cost(
        out, task="hopper-random", work=tmp_path, options=replace(options), models=models, progress=False
    )
    assert json.loads(out.read_text()) == result
    assert result["target_error"] == max(result[f"{name}_best_error"] for name in models)
    for name in models:
        assert 0 <= result[f"{name}_seconds"] <= result[f"{name}_seconds_in_all"]
        assert result[f"{name}_peak_memory_mb"] > 100 and result[f"{name}_parameters"] > 0
    assert not list(tmp_path.glob(".envtf/runs/*"))
