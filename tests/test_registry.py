"""A further algorithm is one file and one line: a toy goes through the pipeline as those that come along do."""

import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
from torch import Tensor

from envtf_lit.agents import registry
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import Batch, Logs, Part
from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.options.numbers import NonNegative
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.evaluate import evaluate
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params, algorithm_of, build_params
from envtf_lit.pipeline.report import report
from envtf_lit.pipeline.stage import METRICS
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.pipeline.yaml import dump_params, load_params, params_yaml, preset_params
from envtf_lit.policy import load_policy
from envtf_lit.training import CURVES
from tests.walker import walker_dataset

# the file


@dataclass(frozen=True)
class ToyOptions(PolicyOptions):
    """The toy's own option.

    Attributes:
        pull: weight of the squared distance to the recorded actions.
    """

    pull: NonNegative = 1.0


class Toy(Agent):
    """Clones the log, at a pull of its own."""

    Options: ClassVar[type[PolicyOptions]] = ToyOptions
    label = "Toy regression"
    options: ToyOptions

    def parts(self) -> dict[str, Part]:
        return dict(actor=Part(self.actor, self.options.actor_learning_rate))

    def losses(self, batch: Batch) -> Iterator[tuple[str, Tensor, Logs]]:
        loss = self.options.pull * self.actor.clone_error(batch["observations"], batch["actions"]).mean()
        yield "actor", loss, dict(toy_loss=loss)


# the line


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry.ALGORITHMS, "toy", Toy)
        yield


SECTION = {"algorithm": "toy", "pull": 2.0, "hidden": [16, 16], "actor_average": 1.0}


def tiny(**section: Any) -> Params:
    """The tiny preset with the toy as its one policy, which acts in the first rollouts, too."""
    tree = dump_params(preset_params("tiny"))
    tree["train_policy"] = {"toy": SECTION | section}
    tree["generate_rollouts"] |= {"policy": "toy", "branches": 20}
    tree["train_model"]["transformer"] |= {"updates": 10, "updates_per_epoch": 10}
    tree["evaluate"] |= {"episodes": 2, "trajectories": 2, "video_frames": 2}
    return build_params(tree | {"threads": 1})


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose stages up to `evaluate` have run."""
    root, params = tmp_path_factory.mktemp("toy"), tiny()
    save_dataset(walker_dataset(episodes=40), root / "log.h5")
    params = replace(params, download=replace(params.download, source="file", path=str(root / "log.h5")))
    download(params, root, progress=False)
    train_policy(params, root, name="toy", progress=False)
    train_model(params, root, progress=False)
    generate_rollouts(params, root, progress=False)
    evaluate(params, root, progress=False)
    return root


def test_a_toy_is_trained_and_published(experiment: Path) -> None:
    folder = experiment / "models/policy/toy"
    curves = (folder / CURVES).read_text().splitlines()
    assert curves[0] == "epoch,train/effective_episodes,train/toy_loss" and len(curves) == 3
    assert read_json(folder / "metrics.json")["toy_loss"] > 0
    settings = read_json(folder / "resolved.json")
    assert settings["algorithm"] == "toy" and settings["options"]["pull"] == 2.0
    assert load_policy(folder).arguments["hidden"] == [16, 16]


def test_a_toy_is_evaluated(experiment: Path) -> None:
    policies = read_json(experiment / METRICS)["policies"]
    assert [*policies] == ["toy"]
    assert policies["toy"]["label"] == "Toy regression" and policies["toy"]["episodes"] == 2
    assert {"score_mean", "score_std", "return_mean", "return_std"} < policies["toy"].keys()


def test_a_toy_is_reported(experiment: Path, repository: Path) -> None:
    pytest.importorskip("papermill")
    from tests.made_up_runs import said  # needs the extra `pipeline`, too

    shutil.copytree(repository / "notebooks", experiment / "notebooks")
    report(tiny(), experiment, progress=False)
    assert "Toy regression" in said(experiment / "reports/report.ipynb")


# what comes with it


def test_a_toy_takes_the_options_that_all_share() -> None:
    options = tiny().train_policy["toy"]
    assert algorithm_of(options) == "toy"
    shared = asdict(preset_params("tiny").policy) | {"hidden": (16, 16), "actor_average": 1.0}
    assert options == ToyOptions(**shared, pull=2.0)


def test_an_unknown_option_of_the_toy_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(UserError, match=r"Unknown option 'pul' in train_policy\.toy: did you mean 'pull'\?"):
        tiny(pul=1.0)
    with pytest.raises(UserError, match=r"train_policy\.toy\.pull is -1\.0, expected a number, 0 or more"):
        tiny(pull=-1.0)
    with pytest.raises(UserError, match=r"train_policy\.toy\.algorithm is 'toi': did you mean 'toy'\?"):
        tiny(algorithm="toi")
    with pytest.raises(UserError, match=r"train_policy\.toy\.world_model is transformer, and toy learns from data"):
        tiny(world_model="transformer")


def test_params_yaml_writes_and_reads_the_toy(tmp_path: Path) -> None:
    text = params_yaml(tiny())
    assert f"algorithm: toy  # {' | '.join(registry.ALGORITHMS)}\n" in text
    assert "pull: 2.0  # weight of the squared distance to the recorded actions\n" in text
    (tmp_path / "params.yaml").write_text(text)
    assert load_params(tmp_path / "params.yaml") == tiny()
    changed = load_params(tmp_path / "params.yaml", ["train_policy.toy.pull=3"])
    assert changed.train_policy["toy"] == replace(tiny().train_policy["toy"], pull=3.0)


# Lightning 2.6's use of an older jsonargparse's names
@pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")
def test_the_command_line_knows_the_toy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["agent", "fit", "--model.algorithm", "toy", "--data.path=data.h5", "--help"])
    assert stop.value.code == 0
    assert "--model.options.pull" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["agent", "fit", "--model.algorithm=toi"])
    assert "--model.algorithm is 'toi': did you mean 'toy'?" in capsys.readouterr().err


# those that come along


def test_each_algorithm_has_frozen_options_and_a_label_of_its_own() -> None:
    algorithms = registry.ALGORITHMS.values()
    assert len({cls.Options for cls in algorithms}) == len({cls.label for cls in algorithms}) == len(algorithms)
    for name, cls in registry.ALGORITHMS.items():
        assert cls.Options.__dataclass_params__.frozen  # pyright: ignore[reportAttributeAccessIssue]
        assert algorithm_of(cls.Options(world_model="transformer" if cls.imagines else "none")) == name


def test_two_algorithms_with_the_same_options_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Twin(Toy):
        """Forgot to have options of its own."""

    monkeypatch.setitem(registry.ALGORITHMS, "twin", Twin)
    with pytest.raises(UserError, match=r"toy and twin have ToyOptions in common: give each options of its own"):
        tiny(algorithm="twin")
