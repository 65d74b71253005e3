"""The Python of README and how-tos runs as it stands, on files like those that the stages write."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.policy import save_policy
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.logs import columns, write

DOCS = Path(__file__).parent.parent / "docs"


def code(page: Path) -> str:
    """All Python of a page, in order."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    assert blocks
    return "\n".join(blocks)


@pytest.fixture
def outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project's folder with dataset, world model and policy of a hopper, and the current one."""
    torch.manual_seed(0)
    log = write(tmp_path / "log.h5", {name: np.concatenate([c] * 4) for name, c in columns().items()})
    (tmp_path / "data").mkdir()
    save_dataset(load_dataset(log, task="hopper-medium").with_split(0.3, 0), tmp_path / "data/dataset.h5")
    save_policy(tmp_path / "models/policy/et_cql", TanhGaussianActor(11, 3, hidden=[8]))
    model = EnvironmentTransformer(11, 3, layers=1, heads=2, width=8, context=8)
    save_world_model(tmp_path / "models/world_model/transformer", model)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_page_from_python_runs(outputs: Path) -> None:
    names = {}
    exec(code(DOCS / "python.md"), names)
    assert names["rollouts"].rewards.shape[1] == 64
    assert names["actions"].shape == names["drawn"].shape == (8, 3)


def test_readmes_python_runs(outputs: Path) -> None:
    names = {"observation": torch.zeros(2, 11)}
    exec(code(DOCS.parent / "README.md"), names)
    assert names["action"].shape == (2, 3)


def test_the_policy_of_a_robot_with_a_simulator_of_its_own_acts_in_it(outputs: Path) -> None:
    actor = TanhGaussianActor(3, 1, hidden=[8], action_low=[-2.0], action_high=[2.0])
    save_policy(Path("models/policy/et_cql"), actor)
    names = {}
    exec(code(DOCS / "another_robot.md").replace("range(10)", "range(1)"), names)
    assert len(names["returns"]) == 1 and names["returns"][0] < 0


def test_the_log_that_the_guide_writes_is_sound(outputs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = columns(3, 1)
    names = {name: log[name] for name in ("observations", "actions", "rewards", "next_observations")}
    names |= {"terminated": log["terminals"], "truncated": log["timeouts"]}
    save_policy(Path("models/policy/et_cql"), TanhGaussianActor(3, 1, hidden=[8]))
    exec(code(DOCS / "own_data.md"), names)
    assert names["action"].shape == (1,)
    main(["data", "check", "my-log.npz"])
    assert "usable: " in capsys.readouterr().out
