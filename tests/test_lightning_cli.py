"""`envtf model …` and `envtf agent …`: what comes from the data, from folders, from checkpoints, and where it goes."""

import json
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import lightning as L
import numpy as np
import pandas as pd
import pytest
import torch

from envtf_lit import load_policy, load_world_model
from envtf_lit.agents.bc import BC
from envtf_lit.agents.cql import CQL, CQLOptions
from envtf_lit.cli.main import main
from envtf_lit.critics import load_critics
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.loaders import Transitions
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.data.sources.minari import write_minari
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.evaluate import evaluate
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.world_models.ensemble import EnsembleDynamics
from tests.lightning_runs import (
    NO_LOGGER,
    QUIET,
    RUN,
    SIZES,
    STILL,
    enter_project,
    envtf,
    fit,
    fit_ensemble,
    named,
    refused,
    same,
    transformer,
)
from tests.test_no_environment import own_log, own_params
from tests.walker import walker_dataset

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a dataset, and the current folder."""
    return enter_project(tmp_path, monkeypatch)


def test_an_agents_validation_against_plain_numbers(folder: Path) -> None:
    torch.manual_seed(0)
    data = TransitionData("data/dataset.h5", discount=0.9)
    agent = CQL(data.observation_dim, data.action_dim, CQLOptions(hidden=(8,), discount=0.9))
    trainer = L.Trainer(logger=False, enable_progress_bar=False, enable_model_summary=False)
    (logged,) = trainer.validate(agent, data, verbose=False)
    rows = Transitions(data.dataset, discount=0.9)[torch.arange(len(data.dataset))]
    returns = data.transitions.complete_returns().numpy()
    scale = returns.std()  # Q counts in this unit, the metrics in the data's
    q = scale * agent.critics(rows["observations"], rows["actions"]).min(0).values.detach().numpy()
    action = agent.average_actor.act(rows["observations"]).numpy()
    assert logged == pytest.approx(
        {
            "val/q_data": q.mean(),
            "val/return_error": np.mean((q - returns) ** 2) / np.var(returns),
            "val/action_error": np.mean((action - data.dataset.actions) ** 2),
        },
        rel=1e-4,
    )
    assert torch.equal(agent.critics.observation_mean, rows["observations"].double().mean(0).float())


def test_the_pipeline_spends_no_time_on_validating_agents(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(CQL, "validation_step", never)
    cql = CQLOptions(updates=20, updates_per_epoch=10, batch_size=8, hidden=(8,))
    metrics = train_policy(Params(threads=1, train_policy={"cql": cql}), progress=False)
    assert "return_error" not in metrics


def test_agent_fit_publishes_a_policy_with_the_datas_scale_and_limits(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit("agent")
    assert ".envtf/published" in capsys.readouterr().out
    policy, dataset = load_policy(".envtf/published"), TransitionData("data/dataset.h5").dataset
    assert policy.action_low.tolist() == [-2.0] * 3 and policy.action_high.tolist() == [2.0] * 3
    np.testing.assert_allclose(policy.observation_mean, np.asarray(dataset.observations).mean(0), atol=1e-6)
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    saved = torch.load(checkpoint, weights_only=True)
    assert saved["hyper_parameters"]["action_low"] == [-2.0] * 3
    assert all(torch.equal(saved["state_dict"][f"average_actor.{k}"], v) for k, v in policy.state_dict().items())
    critics = load_critics(".envtf/published").critics
    assert critics.return_scale == saved["state_dict"]["return_scale"] > 0
    assert all(torch.equal(saved["state_dict"][f"critics.{k}"], v) for k, v in critics.stack.state_dict().items())


def test_agent_fit_trains_the_algorithm_that_is_named(folder: Path) -> None:
    fit("agent", "--model.algorithm=bc")
    assert "train/clone_loss" in pd.read_csv(".envtf/published/curves.csv")
    assert "train/bellman_loss" not in pd.read_csv(".envtf/published/curves.csv")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    BC(11, 3, torch.load(checkpoint, weights_only=True)["hyper_parameters"]["options"])
    envtf("agent", "validate", NO_LOGGER, f"--ckpt_path={checkpoint}")  # of that algorithm without a flag
    Path(".envtf/published").rename("first")
    fit("agent", "--model.init_from=first")  # an actor is an actor
    assert "train/bellman_loss" in pd.read_csv(".envtf/published/curves.csv")


def test_model_fit_trains_the_ensemble_where_its_kind_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit_ensemble("--model.kind=ensemble")
    assert "weights of the members at their best: .envtf/published" in capsys.readouterr().out
    model = load_world_model(".envtf/published")
    assert isinstance(model, EnsembleDynamics) and model.members == 3 and len(model.elite) == 2
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    envtf("model", "validate", NO_LOGGER, f"--ckpt_path={checkpoint}")
    main(["model", "fit", "--config", ".envtf/config.yaml"])
    first, second = (Path(f".envtf/published{name}/weights.safetensors").read_bytes() for name in ("", "_1"))
    assert first == second


def test_model_fit_publishes_and_starts_from_published_weights(folder: Path) -> None:
    fit("model")
    Path(".envtf/published").rename("first")
    fit("model", "--model.init_from=first", learning_rate=STILL)
    first, second = transformer("first"), transformer(".envtf/published")
    assert same(first, second)  # the scale of the same data changes no bit
    save_dataset(walker_dataset(seed=1), "data/dataset.h5")
    fit("model", "--model.init_from=first", learning_rate=STILL)
    second = transformer(".envtf/published")
    assert same(first.blocks, second.blocks)
    assert not torch.equal(first.normaliser.observation_mean, second.normaliser.observation_mean)
    assert first.laplace is not None and second.laplace is not None
    assert not torch.equal(first.laplace.root, second.laplace.root)  # the posterior is that of the new data
    inputs = torch.randn(2, 3, 11), torch.randn(2, 3, 3)
    outcomes = [model.normaliser.outcome(inputs[0], model(*inputs)[0]) for model in (first, second)]
    torch.testing.assert_close(outcomes[1], outcomes[0], rtol=1e-3, atol=1e-4)
    fit("model", "--model.init_from=first")
    assert not same(first.blocks, transformer(".envtf/published").blocks)


@pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec:FutureWarning")
def test_the_stages_take_what_fit_published(folder: Path) -> None:
    save_dataset(replace(own_log(), task=None), "log.npz")
    params = own_params(folder / "log.npz")
    download(params, progress=False)
    few = {"updates": 4, "updates_per_epoch": 1, "learning_rate": 0.1}
    fit("model", "--config=finetune", "--data.held_out=0.25", **few)
    curves, metrics = pd.read_csv(".envtf/published/curves.csv"), read_json(".envtf/published/metrics.json")
    errors = curves["val/open_loop_error"]
    assert (metrics["epoch"], metrics["open_loop_error"]) == (curves["epoch"][errors.argmin()], errors.min())
    assert len(curves) == 4 and 0 <= metrics["termination_false_alarms"] <= 1
    Path("models/policy").mkdir(parents=True, exist_ok=True)
    Path("models/world_model").mkdir(exist_ok=True)
    Path(".envtf/published").rename("models/world_model/transformer")
    for name, algorithm in (("bc", "bc"), ("cql", "cql"), ("et_cql", "cql")):
        fit("agent", f"--model.algorithm={algorithm}", "--data.held_out=0.25")
        Path(".envtf/published").rename(Path("models/policy", name))
    generate_rollouts(params, progress=False)
    metrics = evaluate(params, progress=False)
    assert metrics["world_model"]["termination"] == "learned"
    assert Path("reports/plots/policy_curves.png").exists()
    Path("models/policy/cql/curves.csv").unlink()
    with pytest.raises(UserError, match=r"models/policy/cql has no curves\.csv"):
        evaluate(params, progress=False)


def another_robot() -> None:
    """The project's dataset becomes one of 8 observations and 2 actions."""
    data = walker_dataset(seed=1)
    narrow = dict(observations=data.observations[:, :8], next_observations=data.next_observations[:, :8])
    limit = np.ones(2, np.float32)
    data = replace(data, **narrow, actions=data.actions[:, :2], action_low=-limit, action_high=limit, task=None)
    save_dataset(data, "data/dataset.h5")


@pytest.mark.slow
def test_another_robots_model_keeps_the_frozen_trunk_and_needs_no_flag_for_the_architecture(folder: Path) -> None:
    fit("model")
    Path(".envtf/published").rename("first")
    another_robot()
    budget = {"batch_size": 8, **RUN["model"]}
    envtf("model", "fit", NO_LOGGER, "--model.init_from=first", "--model.freeze=[blocks, norm]", **budget)
    first, second = transformer("first"), transformer(".envtf/published")
    assert (second.observation_dim, second.action_dim, second.options) == (8, 2, first.options)
    assert same(first.blocks, second.blocks) and same(first.norm, second.norm)
    envtf("model", "fit", NO_LOGGER, "--model.init_from=first", **budget)
    assert not same(first.blocks, transformer(".envtf/published").blocks)


def test_another_robots_policy_keeps_the_frozen_hidden_layers(folder: Path) -> None:
    fit("agent", hidden=[8, 8])
    Path(".envtf/published").rename("first")
    another_robot()
    budget = {"batch_size": 8, "warm_start": 0.5, **RUN["agent"]}
    envtf("agent", "fit", NO_LOGGER, "--model.init_from=first", "--model.freeze=[net.2]", **budget)
    first, second = load_policy("first"), load_policy(".envtf/published")
    assert second.arguments["observation_dim"] == 8 and second.arguments["hidden"] == [8, 8]
    assert same(first.net[2], second.net[2]) and first.get_parameter("net.2.weight").any()


def test_the_shipped_configuration_stops_early_and_publishes_the_best_epoch(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit("model")
    Path(".envtf/published").rename("first")
    shutil.rmtree(".envtf")
    capsys.readouterr()
    started = ["model", "fit", "--config=finetune", "--data.path=data/dataset.h5", "--model.init_from=first", NO_LOGGER]
    budget = [*QUIET, *(f"--model.options.{name}=1" for name in ("batch_size", "updates_per_epoch"))]
    main([*started, *budget, f"--model.options.learning_rate={STILL}"])  # nothing can get better
    assert "the weights of the epoch of best val/open_loop_error" in capsys.readouterr().out
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    assert "epoch=0" in checkpoint.name  # of equals the first is best
    assert same(load_world_model("first"), load_world_model(".envtf/published"))
    main([*started, *budget, "--model.options.learning_rate=1", "--trainer.max_epochs=4"])  # nor here, after that
    (best,) = set(Path(".envtf").rglob("*.ckpt")) - {checkpoint}
    kept = torch.load(best, weights_only=True)["state_dict"]
    published = load_world_model(".envtf/published_1").state_dict()
    assert all(torch.equal(kept[f"model.{name}"], published[name]) for name in published if name.startswith("blocks"))


def test_data_of_minari_are_named_by_their_id(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    write_minari(load_dataset("data/dataset.h5"), "ours/walker-v0")
    for source, path in (("file", "data/dataset.h5"), ("minari", "ours/walker-v0")):
        options = named({**SIZES["model"], **RUN["model"]})
        main(["model", "fit", NO_LOGGER, *QUIET, f"--data.source={source}", f"--data.path={path}", *options])
        Path(".envtf/published").rename(f"from_{source}")
    assert same(load_world_model("from_file"), load_world_model("from_minari"))


def test_agent_fit_starts_its_actor_from_a_published_policy_and_warms_up_critics_alone(folder: Path) -> None:
    fit("agent")
    Path(".envtf/published").rename("first")
    fit("agent", "--model.init_from=first", "--model.seed=1", warm_start=20)  # all of them
    assert same(load_policy("first"), load_policy(".envtf/published"))
    fit("agent", "--model.init_from=first", "--model.seed=1", warm_start=0)
    assert not same(load_policy("first"), load_policy(".envtf/published"))


@pytest.mark.parametrize(
    ("kind", "change", "sentence"),
    [
        ("model", {"width": 8}, "first does not fit the model: width is 16 there and 8 here"),
        ("agent", {"hidden": [9]}, "first does not fit the actor: hidden is [8] there and [9] here"),
    ],
)
def test_weights_of_another_shape_are_refused(
    kind: str, change: dict[str, object], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit(kind)
    Path(".envtf/published").rename("first")
    options = {**SIZES[kind], **RUN[kind], **change}
    assert sentence in refused(capsys, kind, "fit", NO_LOGGER, "--model.init_from=first", **options)
    missing = refused(capsys, kind, "fit", NO_LOGGER, "--model.init_from=nowhere", **options)
    assert "nowhere/config.json does not exist" in missing


def test_a_saved_config_is_a_config(folder: Path) -> None:
    fit("agent")
    main(["agent", "fit", "--config", ".envtf/config.yaml"])
    first, second = (Path(f".envtf/published{name}/weights.safetensors").read_bytes() for name in ("", "_1"))
    assert first == second


def test_runs_do_not_overwrite_one_another_nor_a_file_of_the_users(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(".envtf/published").mkdir(parents=True)
    for mine in (".envtf/published/notes.txt", ".envtf/config.yaml"):
        Path(mine).write_text("mine")
    options = named({**SIZES["agent"], **RUN["agent"]})
    command = ["agent", "fit", "--data.path", "data/dataset.h5", *QUIET, *options]
    for number in (1, 2):
        main([*command, NO_LOGGER])
        assert f": .envtf/published_{number}\n" in capsys.readouterr().out
        assert Path(f".envtf/config_{number}.yaml").is_file()
        load_policy(f".envtf/published_{number}")
    main([*command, "--trainer.fast_dev_run=true"])
    names = {"published", "published_1", "published_2", "config.yaml", "config_1.yaml", "config_2.yaml", "checkpoints"}
    assert {path.name for path in Path(".envtf").iterdir()} == names
    assert [path.read_text() for path in (Path(".envtf/published/notes.txt"), Path(".envtf/config.yaml"))] == [
        "mine"
    ] * 2


@pytest.mark.parametrize(
    ("flags", "written"),
    [
        (["CSVLogger", "--trainer.logger.save_dir=logs"], "logs/lightning_logs/version_0/metrics.csv"),
        (["dvclive.lightning.DVCLiveLogger", "--trainer.logger.dvcyaml=null"], "dvclive/plots/metrics/val/loss.tsv"),
        (["TensorBoardLogger", "--trainer.logger.save_dir=logs"], "logs/lightning_logs/version_0/events.out.*"),
    ],
)
def test_loggers(flags: list[str], written: str, folder: Path) -> None:
    if flags[0].startswith("TensorBoard"):
        pytest.importorskip("tensorboard")
    envtf("model", "fit", f"--trainer.logger={flags[0]}", *flags[1:], **{**SIZES["model"], **RUN["model"]})
    (file,) = folder.glob(written)
    assert file.stat().st_size > 0
    (weights,) = folder.rglob("published/weights.safetensors")
    assert json.loads((weights.parent / "config.json").read_text())["kind"] == "environment_transformer"
    assert list(folder.rglob("config.yaml"))


@pytest.mark.skipif(find_spec("wandb") is not None, reason="W&B is installed")
def test_a_logger_that_is_not_installed_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sentence = refused(capsys, "model", "fit", "--trainer.logger=WandbLogger", **{**SIZES["model"], **RUN["model"]})
    assert "wandb" in sentence and "pip install" in sentence
