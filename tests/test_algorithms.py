"""Every algorithm that there is goes through the pipeline, and is told apart in its figures."""

import re
import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envtf_lit.actors import kind_of
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.figures.style import COLOURS, policy_colours
from envtf_lit.files import read_json
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.evaluate import evaluate
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params, build_params
from envtf_lit.pipeline.report import report
from envtf_lit.pipeline.stage import METRICS
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.pipeline.yaml import dump_params, preset_params
from envtf_lit.policy import load_policy
from envtf_lit.world_models.store import load_world_model
from tests.test_training import Killed, bytes_of, kill_in_epoch
from tests.walker import walker_dataset

SLOW = pytest.mark.slow
TRANSFORMER = ("et_cql_paper", "et_cql")
SHORT = {"branches": 8, "horizon": 2}
OWN: dict[str, dict[str, Any]] = {  # so that each has all its parts in twenty updates
    "rambo": {"warm_start": 0.2, "adversarial_every": 5, "adversarial_updates": 2},
    "et_cql": {"critic_updates": 5, "value_gradient": {"updates": 5, "rollouts": 4, "horizon": 4}},
}


def section(name: str) -> dict[str, Any]:
    """A policy of that algorithm, with a world model if it needs one."""
    options: dict[str, Any] = {"algorithm": name}
    if ALGORITHMS[name].imagines:
        model = "transformer" if name in TRANSFORMER else "ensemble"
        options |= {"world_model": model, "refresh_every": 10, "rollouts": SHORT}
    return options | OWN.get(name, {})


@pytest.fixture(scope="module")
def params() -> Params:
    """All algorithms side by side, and both world models, in twenty updates each."""
    tree = dump_params(preset_params("tiny"))
    tree["policy"] |= {"updates": 20, "updates_per_epoch": 10, "batch_size": 16, "hidden": [16, 16]}
    tree["train_policy"] = {name: section(name) for name in ALGORITHMS}
    tree["train_model"]["transformer"] |= {"updates": 10, "updates_per_epoch": 10}
    tree["train_model"]["ensemble"] = dict(
        kind="ensemble", members=3, elites=2, hidden=[16], weight_decay=[0.0, 0.0], updates=10, updates_per_epoch=10
    )
    tree["generate_rollouts"] |= {"branches": 10}
    tree["evaluate"] |= {"episodes": 1, "trajectories": 2, "video_frames": 2}
    return build_params(tree | {"threads": 1})


@pytest.fixture(scope="module")
def project(params: Params, tmp_path_factory: pytest.TempPathFactory) -> tuple[Params, Path]:
    """A project with world models and their first rollouts."""
    root = tmp_path_factory.mktemp("algorithms")
    save_dataset(walker_dataset(episodes=20), root / "log.h5")
    params = replace(params, download=replace(params.download, source="file", path=str(root / "log.h5")))
    download(params, root, progress=False)
    train_policy(params, root, name="bc", progress=False)
    for model in params.train_model:
        train_model(params, root, name=model, progress=False)
        generate_rollouts(params, root, name=model, progress=False)
    return params, root


@pytest.mark.parametrize("name", [name for name in ALGORITHMS if name != "bc"])
def test_an_algorithm_is_trained_and_its_policy_acts(name: str, project: tuple[Params, Path]) -> None:
    params, root = project
    model = params.train_policy[name].world_model
    before = None if model == "none" else load_world_model(root / "models/world_model" / model).state_dict()
    metrics = train_policy(params, root, name=name, progress=False)
    assert metrics and all(np.isfinite(value) for value in metrics.values())
    policy = load_policy(root / "models/policy" / name)
    kinds = {"td3_bc": "deterministic", "rebrac": "deterministic", "iql": "gaussian"}
    assert kind_of(policy) == kinds.get(name, "tanh_gaussian")
    action = policy.act(torch.as_tensor(walker_dataset(episodes=1).observations))
    assert action.shape == (20, 3) and action.abs().max() <= 1.0
    assert read_json(root / "models/policy" / name / "resolved.json")["algorithm"] == name
    if before is not None:
        after = load_world_model(root / "models/world_model" / model).state_dict()
        assert all(torch.equal(value, before[key]) for key, value in after.items())


@pytest.mark.parametrize("name", ["rambo", *(pytest.param(x, marks=SLOW) for x in ("td3_bc", "iql", "mobile"))])
def test_a_run_that_was_killed_goes_on_to_the_same_policy(
    name: str, project: tuple[Params, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit: target actors, state values and a world model that learns on are in the checkpoint, too."""
    params, root = project
    folder = root / "models/policy" / name
    train_policy(params, root, name=name, progress=False)
    whole = bytes_of(folder)
    shutil.rmtree(folder)
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 1)
        with pytest.raises(Killed):
            train_policy(params, root, name=name, progress=False)
    assert not folder.exists()
    train_policy(params, root, name=name, progress=False)
    assert bytes_of(folder) == whole


@pytest.mark.slow
def test_all_are_evaluated_and_reported_side_by_side(
    project: tuple[Params, Path], repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("papermill")
    from tests.made_up_runs import said

    params, root = project
    for name in ALGORITHMS:
        train_policy(params, root, name=name, progress=False)
    evaluate(params, root, progress=False)
    policies = read_json(root / METRICS)["policies"]
    assert {name: policy["label"] for name, policy in policies.items()} == {
        name: cls.label for name, cls in ALGORITHMS.items()
    }
    shutil.copytree(repository / "notebooks", root / "notebooks")
    report(params, root, progress=False)
    text = said(root / "reports/report.ipynb")
    assert all(cls.label in text for cls in ALGORITHMS.values())


def lab(colour: str) -> np.ndarray:
    """CIE L*a*b* of `#rrggbb`, under D65."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    f = np.cbrt(to_xyz @ linear / np.array([0.95047, 1.0, 1.08883]))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_all_algorithms_have_colours_that_can_be_told_apart() -> None:
    """By 25 units of L*a*b*, as far as Okabe and Ito's two blues; from imagination's colour and the log's, too."""
    colours = [*policy_colours(ALGORITHMS).values(), COLOURS["imagined"], COLOURS["data"], "#ffffff"]
    assert len(set(colours)) == len(ALGORITHMS) + 3
    for one, other in combinations(colours, 2):
        assert np.linalg.norm(lab(one) - lab(other)) > 25, (one, other)


def test_each_algorithm_has_a_page_that_says_all_and_names_tests_there_are(repository: Path) -> None:
    pages = {path.stem: path.read_text() for path in (repository / "docs/algorithms").glob("*.md")}
    assert pages.keys() - {"README"} == ALGORITHMS.keys()
    tests = "\n".join(path.read_text() for path in (repository / "tests").glob("test_*.py"))
    for name in ALGORITHMS:
        assert pages[name].partition("\n")[0].endswith(f"`{name}`")
        headings = re.findall(r"^## (.+)", pages[name], re.MULTILINE)
        assert headings == ["Equation", "Source", "Settings", "Limits", "Known answers"], name
        named = re.findall(r"`(test_\w+)`", pages[name].partition("## Known answers")[2])
        assert named, name
        assert [test for test in named if f"def {test}(" not in tests] == []
