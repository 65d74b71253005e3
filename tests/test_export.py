"""Exported policies and world models: they say what PyTorch says, run without it, and are whole or absent."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from envtf_lit.actors import POLICIES, Actor, GaussianActor, TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.export import export_policy, export_world_model
from envtf_lit.policy import RandomPolicy, save_policy
from envtf_lit.world_models.step_graph import NEXT, StepGraph, step_graph
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.worlds import linear_gaussians, small_transformer

S, A = 3, 2
CLOSE: dict[str, Any] = {"rtol": 1e-5, "atol": 1e-5}


def actor(kind: str = "tanh_gaussian") -> Actor:
    torch.manual_seed(0)
    policy = POLICIES[kind](S, A, hidden=(8,), action_low=(-2.0, 0.0), action_high=(1.0, 0.5)).eval()
    policy.observation_mean.copy_(torch.tensor([1.0, -20.0, 0.0]))
    policy.observation_std.copy_(torch.tensor([0.1, 30.0, 1.0]))
    return policy


def transformer() -> EnvironmentTransformer:
    """With everything that a trained one has: a posterior, tails, recalibrated variances, two heads, wild weights."""
    torch.manual_seed(0)
    options: dict[str, Any] = dict(layers=1, heads=2, width=8, context=4, random_features=4)
    model = EnvironmentTransformer(S, A, **options).eval().requires_grad_(False)
    for weight in model.parameters():
        weight.add_(0.3 * torch.randn_like(weight))
    assert model.laplace is not None and model.random_features is not None
    model.laplace.root.copy_(0.3 * torch.randn_like(model.laplace.root).tril())
    model.laplace.residual.fill_(0.5)
    model.laplace.scale.fill_(1.0)
    model.random_features.weight.normal_()
    model.recalibration.copy_(torch.tensor([0.5, 1.0, 2.0, 3.0]))
    model.tail.copy_(torch.tensor([0.0, 0.1, 0.4, 0.8]))
    model.normaliser.observation_std.copy_(torch.tensor([2.0, 1.0, 0.5]))
    model.normaliser.target_std.copy_(torch.tensor([0.2, 0.1, 0.05, 3.0]))
    return model


def inputs(rows: int, steps: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    return torch.randn(rows, steps, S, generator=generator), torch.randn(rows, steps, A, generator=generator)


def step(graph: StepGraph, carried: dict[str, Tensor], observation: Tensor, action: Tensor) -> dict[str, Tensor]:
    noise = torch.zeros(len(observation), S + 1)
    given = {"observation": observation, "action": action, "noise": noise} | carried
    return dict(zip(graph.outputs, graph(*(given[name] for name in graph.inputs)), strict=True))


def carried(found: dict[str, Tensor]) -> dict[str, Tensor]:
    state = {name.removeprefix(NEXT): value for name, value in found.items() if name.startswith(NEXT)}
    del state["observation"]
    return state


# the step as a function


def test_a_rollout_of_the_function_is_that_of_the_model_far_past_its_context() -> None:
    model = transformer()
    graph, (observations, actions) = step_graph(model), inputs(2, 54)
    state = model.init(observations[:, :1], actions[:, :0], torch.ones(2, dtype=torch.int64))
    found = {"next_observation": observations[:, 0], **{NEXT + k: v for k, v in graph.start(2).items()}}
    for t in range(54):
        found = step(graph, carried(found), found["next_observation"], actions[:, t])
        state, expected = model.step(state, actions[:, t])
        assert torch.allclose(found["next_observation"], expected.observation, **CLOSE), t
        assert torch.allclose(found["uncertainty"], expected.uncertainty, **CLOSE), t
        assert expected.epistemic is not None and expected.novelty is not None
        assert torch.allclose(found["epistemic"], expected.epistemic, **CLOSE)
        assert torch.allclose(found["novelty"], expected.novelty, **CLOSE)
    assert found["next_clock"].tolist() == [54, 54]


def test_rows_with_histories_of_different_length_step_together() -> None:
    model = transformer()
    graph, (observations, actions) = step_graph(model), inputs(2, 6)
    lengths = torch.tensor([2, 6])
    state = model.init(observations, actions[:, :-1], lengths)
    _, expected = model.step(state, actions[:, -1])
    rows = []
    for row, length in enumerate(lengths.tolist()):  # each alone, one recorded pair after another
        state = graph.start(1)
        for t in range(length - 1):
            state = carried(step(graph, state, observations[row : row + 1, t], actions[row : row + 1, t]))
        rows.append(state)
    together = {name: torch.cat([state[name] for state in rows]) for name in rows[0]}
    assert together["clock"].tolist() == [1, 5]
    current = observations[torch.arange(2), lengths - 1]
    found = step(graph, together, current, actions[:, -1])
    assert torch.allclose(found["mean"], expected.mean, **CLOSE)
    assert torch.allclose(found["aleatoric"], expected.aleatoric, **CLOSE)


def test_noise_is_the_samples() -> None:
    model = transformer()
    graph, (observations, actions) = step_graph(model), inputs(3, 1)
    state = model.init(observations, actions[:, :0], torch.ones(3, dtype=torch.int64))
    _, expected = model.step(state, actions[:, 0], mode="sample", generator=torch.Generator().manual_seed(1))
    noise = torch.empty(3, S + 1).normal_(generator=torch.Generator().manual_seed(1))
    found = dict(
        zip(graph.outputs, graph(observations[:, 0], actions[:, 0], noise, *graph.start(3).values()), strict=True)
    )
    assert torch.allclose(found["next_observation"], expected.observation, **CLOSE)
    assert torch.allclose(found["reward"], expected.reward, **CLOSE)
    assert not torch.allclose(found["reward"], found["mean"][:, -1], **CLOSE)


def test_a_row_of_an_ensemble_follows_its_elite() -> None:
    model = linear_gaussians()
    graph, (observations, actions) = step_graph(model), inputs(4, 1)
    o, a, noise = observations[:, 0, :S], actions[:, 0, : model.action_dim], torch.randn(4, S + 1)
    means, log_variances = model(model.normaliser.token(o, a))
    for elite in (-1, 0, 2):
        found = dict(zip(graph.outputs, graph(o, a, noise, torch.full((4,), elite)), strict=True))
        mean = means.mean(0) if elite < 0 else means[elite]
        outcome = mean + torch.exp(0.5 * log_variances[max(elite, 0)]) * noise
        assert torch.allclose(found["next_observation"], model.normaliser.outcome(o, outcome)[:, :-1], **CLOSE)
        assert torch.allclose(found["mean"], model.normaliser.outcome(o, means.mean(0)), **CLOSE)


# files


@pytest.mark.parametrize("kind", ["gaussian", "deterministic"])
def test_an_exported_policy_acts_as_the_policy(tmp_path: Path, kind: str) -> None:
    policy, out = actor(kind), tmp_path / "policy.pt2"
    export_policy(policy, out)
    extra = {"metadata.json": ""}
    program = torch.export.load(out, extra_files=extra).module()
    facts = json.loads(extra["metadata.json"])
    assert facts["kind"] == kind and facts["action_low"] == [-2.0, 0.0] and facts["versions"]["torch"]
    observation = policy.observation_mean + policy.observation_std * torch.randn(7, S)
    action, mean, log_std = program(observation, torch.zeros(7, A))
    assert torch.allclose(action, policy.act(observation), **CLOSE)
    assert torch.equal(log_std.isinf(), torch.full((7, A), kind == "deterministic"))
    drawn = policy.act(observation, False, torch.Generator().manual_seed(3))
    noise = torch.randn(7, A, generator=torch.Generator().manual_seed(3))
    assert torch.allclose(program(observation, noise)[0], drawn, **CLOSE)
    assert mean.abs().max() <= 1


SCRIPT = Path(__file__).parent.parent / "examples/run_onnx.py"


def test_a_policy_runs_in_onnxruntime_and_says_what_it_is(tmp_path: Path) -> None:
    policy, out = actor(), tmp_path / "policy.onnx"
    export_policy(policy, out)
    session = onnxruntime.InferenceSession(str(out))
    facts = session.get_modelmeta().custom_metadata_map
    assert facts["kind"] == "tanh_gaussian" and json.loads(facts["action_high"]) == [1.0, 0.5]
    assert json.loads(facts["versions"])["envtf-lit"]
    assert [value.shape for value in session.get_inputs()] == [["batch", S], ["batch", A]]
    for rows in (1, 7):
        observation = policy.observation_mean + policy.observation_std * torch.randn(rows, S)
        given: dict[str, Any] = {"observation": observation.numpy(), "noise": np.zeros((rows, A), np.float32)}
        found = session.run(["action"], given)[0]
        assert np.allclose(np.asarray(found), policy.act(observation), **CLOSE)


@pytest.mark.slow
def test_twenty_lines_run_both_without_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_policy(tmp_path / "policy", actor())
    save_world_model(tmp_path / "world", transformer())
    monkeypatch.chdir(tmp_path)
    main(["export", "policy", "policy", "policy.onnx"])
    main(["export", "model", "world", "world_model.onnx"])
    assert len(SCRIPT.read_text().splitlines()) <= 20
    imports = {line for line in SCRIPT.read_text().splitlines() if "import" in line and not line.startswith('"""')}
    assert imports == {"import numpy as np", "import onnxruntime"}
    found = subprocess.run([sys.executable, "-I", SCRIPT], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    rows = np.array([line.split() for line in found.stdout.splitlines()], float)
    assert rows.shape == (60, 3) and np.isfinite(rows).all()
    assert (rows[:, 2] > 0).all() and len(np.unique(rows[:, 1])) == 60
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".onnx", ".pt2"])
def test_every_kind_is_exported_to_either_format(tmp_path: Path, ending: str) -> None:
    for kind in POLICIES:
        export_policy(actor(kind), tmp_path / f"{kind}{ending}")
    models = {"head": small_transformer("head"), "none": small_transformer("none"), "ensemble": linear_gaussians()}
    for name, model in models.items():
        export_world_model(model.requires_grad_(False), tmp_path / f"{name}{ending}")
    assert len(list(tmp_path.iterdir())) == 6


# refused


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    uniform: Any = RandomPolicy(-torch.ones(A), torch.ones(A))
    with pytest.raises(UserError, match="A RandomPolicy cannot be exported: give a policy that was trained"):
        export_policy(uniform, tmp_path / "policy.onnx")
    other: Any = torch.nn.Linear(1, 1)
    with pytest.raises(UserError, match="A Linear cannot be exported: give an EnvironmentTransformer or an ensemble"):
        export_world_model(other, tmp_path / "model.onnx")
    with pytest.raises(UserError, match=r"ends in '.pt': name an exported file .onnx or .pt2"):
        export_policy(actor(), tmp_path / "policy.pt")
    assert not list(tmp_path.iterdir())
    (tmp_path / "policy.onnx").write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        export_policy(actor(), tmp_path / "policy.onnx")
    assert (tmp_path / "policy.onnx").read_text() == "mine"


class Drifting(GaussianActor):
    """Acts a little otherwise than what is exported."""

    def act(self, *arguments: Any, **options: Any) -> Tensor:
        return super().act(*arguments, **options) + 1e-3


def test_a_file_that_differs_from_pytorch_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(POLICIES, "gaussian", Drifting)
    with pytest.raises(UserError, match=r"was not written: its action differs from PyTorch's by 0\.0005 of its size"):
        export_policy(Drifting(S, A, hidden=()).eval(), tmp_path / "policy.pt2")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("missing", ["onnxscript", "onnxruntime"])
def test_onnx_without_its_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError, match=rf"ONNX needs .*{missing}.*: pip install 'envtf-lit\[export\]'\.$"):
        export_policy(actor(), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


# envtf policy act


def act(folder: Path, values: Any, *more: str) -> None:
    np.save(folder / "obs.npy", values, allow_pickle=True)
    if not (folder / "policy").exists():
        save_policy(folder / "policy", actor())
    main(["policy", "act", "--policy", str(folder / "policy"), "--observation", str(folder / "obs.npy"), *more])


def test_a_policy_acts_on_an_array(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = actor().act(torch.ones(2, S)).numpy()
    act(tmp_path, np.ones(S))
    assert np.allclose(json.loads(capsys.readouterr().out), expected[0])
    act(tmp_path, np.ones((2, S)), "--out", str(tmp_path / "actions.npy"))
    assert np.allclose(np.load(tmp_path / "actions.npy"), expected)


BAD = {
    "NaN": (np.array([1.0, math.nan, 0.0]), r"holds nan at \(1,\), for which there is no action"),
    "too large": (np.array([[1.0, 0.0, 1e300]]), r"holds inf at \(0, 2\)"),
    "other dimensions": (np.ones(4), r"has shape \(4,\), and the policy wants \(3,\) or \(rows, 3\)"),
    "no rows": (np.ones((0, 3)), r"has shape \(0, 3\)"),
    "objects": (np.array([{}, {}, {}]), "is not a .npy file of numbers"),
    "text": (np.array(["a", "b", "c"]), "holds no array of numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_observation_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    values, sentence = BAD[name]
    with pytest.raises(SystemExit):
        act(tmp_path, values)
    error = " ".join(capsys.readouterr().err.split())
    assert re.search(sentence, error), error


def test_an_array_that_declares_more_than_it_holds_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    act(tmp_path, np.ones((2, S)), "--out", str(tmp_path / "a.npy"))
    path = tmp_path / "obs.npy"
    content = path.read_bytes().replace(b"(2, 3), }         ", b"(9000000000, 3), }")
    (tmp_path / "huge.npy").write_bytes(content)
    with pytest.raises(SystemExit):
        main(["policy", "act", "--policy", str(tmp_path / "policy"), "--observation", str(tmp_path / "huge.npy")])
    assert "is not a .npy file of numbers" in capsys.readouterr().err


def test_a_tanh_gaussian_mean_is_before_the_tanh() -> None:
    policy = actor()
    assert isinstance(policy, TanhGaussianActor)
    observation = policy.observation_mean + torch.zeros(1, S)
    mean, _ = policy(observation)
    assert torch.allclose(
        policy.act(observation), policy.action_low + 0.5 * (mean.tanh() + 1) * torch.tensor([3.0, 0.5])
    )
