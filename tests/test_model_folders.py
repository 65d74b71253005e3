"""Module folders: what is damaged, foreign or of absurd sizes ends in one sentence."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.errors import UserError
from envtf_lit.files import write_json
from envtf_lit.model_folders import load_weights
from envtf_lit.policy import load_policy, save_policy
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.store import load_world_model, save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    save_policy(tmp_path / "policy", TanhGaussianActor(3, 2, hidden=(8,)))
    return tmp_path / "policy"


def change_arguments(folder: Path, **changes: object) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["arguments"].update(changes)
    write_json(folder / "config.json", config)


def change_weight(folder: Path, name: str, value: float) -> None:
    tensors = load_file(folder / "weights.safetensors")
    tensors[name].fill_(value)
    save_file(tensors, folder / "weights.safetensors")


def test_what_was_saved_comes_back(policy: Path) -> None:
    again = load_policy(policy)
    save_policy(policy.with_name("again"), again)
    for name in ("weights.safetensors", "config.json"):
        assert (policy / name).read_bytes() == (policy.with_name("again") / name).read_bytes()


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no weights": (lambda f: (f / "weights.safetensors").unlink(), r"weights\.safetensors does not exist"),
    "no config": (lambda f: (f / "config.json").unlink(), r"config\.json does not exist"),
    "pickle": (lambda f: torch.save({}, f / "weights.safetensors"), "is not a safetensors file"),
    "cut weights": (lambda f: os.truncate(f / "weights.safetensors", 300), "is not a safetensors file"),
    "cut config": (lambda f: os.truncate(f / "config.json", 40), "is not valid JSON"),
    "empty config": (lambda f: (f / "config.json").write_text(""), "is not valid JSON"),
    "binary config": (lambda f: (f / "config.json").write_bytes(b"\xff\xfe"), "is not valid JSON"),
    "a list": (lambda f: write_json(f / "config.json", [1]), "unknown kind ''"),
    "no arguments": (lambda f: write_json(f / "config.json", {"kind": "tanh_gaussian"}), "does not describe"),
    "a class path": (lambda f: write_json(f / "config.json", {"kind": "os.system"}), "unknown kind 'os.system'"),
    "odd argument": (lambda f: change_arguments(f, colour="red"), "does not describe a tanh_gaussian"),
    "text for a number": (lambda f: change_arguments(f, observation_dim="x"), "does not describe a tanh_gaussian"),
    "impossible size": (lambda f: change_arguments(f, observation_dim=-1), "does not describe a tanh_gaussian"),
    "more dimensions": (lambda f: change_arguments(f, observation_dim=10**8), r"in the file and \(8, 100000000\) in"),
    "more layers": (lambda f: change_arguments(f, hidden=[8] * 10**5), "far more tensors than the weights' file"),
    "beyond integers": (lambda f: change_arguments(f, observation_dim=10**30), "does not describe a tanh_gaussian"),
    "NaN": (lambda f: change_weight(f, "net.0.bias", torch.nan), r"holds nan in net\.0\.bias: .* train it anew"),
    "infinity": (lambda f: change_weight(f, "net.0.bias", torch.inf), r"holds inf in net\.0\.bias"),
    "NaN scale": (lambda f: change_weight(f, "observation_std", torch.nan), "holds nan in observation_std"),
    "no range of actions": (lambda f: change_weight(f, "action_low", 1.0), r"action limits \[1\.0, 1\.0\] and \[1\.0"),
    "endless actions": (lambda f: change_weight(f, "action_high", torch.inf), r"action limits .* finite"),
    "other shape": (lambda f: change_arguments(f, hidden=[9]), r"net\.0\.bias has shape \(8,\) in the file and \(9,\)"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_folder_is_refused_in_a_sentence(policy: Path, damage: str) -> None:
    break_it, sentence = DAMAGE[damage]
    break_it(policy)
    with pytest.raises(UserError, match=sentence) as caught:
        load_policy(policy)
    assert str(policy) in str(caught.value)


ABSURD = """
import sys, time
from pathlib import Path
from envtf_lit.errors import UserError
from envtf_lit.world_models.store import load_world_model

def peak():
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])  # in KB


for folder, sentence in zip(sys.argv[1::2], sys.argv[2::2]):
    before, start = peak(), time.process_time()
    try:
        load_world_model(folder)
    except UserError as error:
        seconds, memory = time.process_time() - start, peak() - before
        assert seconds < 2 and memory < 500_000, (folder, seconds, memory)
        assert sentence in str(error), error
    else:
        raise SystemExit(f"{folder} was loaded")
"""
SIZES = {
    "states": ({"observation_dim": 10**8}, "does not fit the model"),
    "wide": ({"width": 10**8}, "does not fit the model"),
    "features": ({"random_features": 10**8}, "does not fit the model"),
    "deep": ({"layers": 10**7}, "far more tensors than the weights' file"),
    "headless": ({"heads": 0}, "does not describe a environment_transformer"),
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from there")
def test_absurd_sizes_are_refused_before_they_cost_anything(tmp_path: Path) -> None:
    """In one process for all, since most of its time goes into starting."""
    command = [sys.executable, "-c", ABSURD]
    for name, (size, sentence) in SIZES.items():
        save_world_model(tmp_path / name, EnvironmentTransformer(3, 2, layers=1, heads=1, width=4, context=2))
        change_arguments(tmp_path / name, **size)
        command += [str(tmp_path / name), sentence]
    child = subprocess.run(command, capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere is not a model folder: it does not exist"):
        load_policy(tmp_path / "nowhere")


def test_each_loader_takes_its_own_kind_alone(policy: Path, tmp_path: Path) -> None:
    options = ModelOptions(layers=1, heads=1, width=4, context=2)
    model = EnvironmentTransformer(3, 2, **vars(options))
    save_world_model(tmp_path / "model", model)
    with pytest.raises(UserError, match="unknown kind 'environment_transformer'"):
        load_policy(tmp_path / "model")
    with pytest.raises(UserError, match="unknown kind 'tanh_gaussian'"):
        load_world_model(policy)
    with pytest.raises(UserError, match="does not fit the model"):
        load_weights(model, policy / "weights.safetensors")


def test_who_loads_a_module_draws_what_they_would_have_drawn(policy: Path) -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    load_policy(policy)
    assert torch.equal(torch.rand(3), expected)
