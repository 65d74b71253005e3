"""`envtf model …` and `envtf agent …`: what comes from the data, from folders, from checkpoints, and where it goes."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import pandas as pd
import pytest
import torch
from ruamel.yaml import YAML

from envtf_lit import load_policy, load_world_model
from envtf_lit.agents.bc import BC
from envtf_lit.agents.cql import CQL, CQLOptions
from envtf_lit.cli.arguments import given
from envtf_lit.cli.main import main
from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.data.loaders import Transitions
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.data.sources.minari import write_minari
from envtf_lit.errors import UserError
from envtf_lit.files import read_json, write_json
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.evaluate import evaluate
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.world_models.ensemble import EnsembleDynamics
from tests.test_no_environment import own_log, own_params
from tests.walker import walker_dataset

SIZES = {
    "model": {"layers": 1, "heads": 2, "width": 16, "context": 4, "batch_size": 8},
    "agent": {"hidden": [8], "warm_start": 0.5, "batch_size": 8},
}
ENSEMBLE = {"members": 3, "elites": 2, "hidden": [8], "weight_decay": [0, 0], "batch_size": 8}
STILL = 1e-30  # a learning rate too small to change any bit
RUN = {"model": {"updates_per_epoch": 2, "updates": 4}, "agent": {"updates_per_epoch": 10, "updates": 20}}
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
NO_LOGGER = "--trainer.logger=false"

# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project whose dataset has actions in [-2, 2]."""
    limit = np.full(3, 2.0, np.float32)
    save_dataset(replace(walker_dataset(), action_low=-limit, action_high=limit), tmp_path / "data/dataset.h5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def envtf(kind: str, verb: str, *flags: str, **options: object) -> None:
    """Runs a Lightning command line on the project's dataset; a fit has `.envtf/published` to itself."""
    if verb == "fit":
        shutil.rmtree(".envtf/published", ignore_errors=True)  # an earlier one, beside which it would go
    main([kind, verb, "--data.path", "data/dataset.h5", *QUIET, *flags, *named(options)])


def named(options: Mapping[str, object]) -> list[str]:
    """Options of the model as flags."""
    return [f"--model.options.{name}={value}" for name, value in options.items()]


def fit(kind: str, *flags: str, **options: object) -> None:
    envtf(kind, "fit", NO_LOGGER, *flags, **{**SIZES[kind], **RUN[kind], **options})


def fit_ensemble(*flags: str, **options: object) -> None:
    envtf("model", "fit", NO_LOGGER, *flags, **{**ENSEMBLE, **RUN["model"], **options})


def refused(capsys: pytest.CaptureFixture[str], kind: str, verb: str, *flags: str, **options: object) -> str:
    """The one sentence with which a command ends in status 2."""
    with pytest.raises(SystemExit) as stop:
        envtf(kind, verb, *flags, **options)
    assert stop.value.code == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in "\n".join(errors)
    return errors[-1]


def same(first: torch.nn.Module, second: torch.nn.Module) -> bool:
    a, b = first.state_dict(), second.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# what the pipeline and the command line share


def test_an_agents_validation_against_plain_numbers(folder: Path) -> None:
    torch.manual_seed(0)
    data = TransitionData("data/dataset.h5", discount=0.9)
    agent = CQL(data.observation_dim, data.action_dim, CQLOptions(hidden=(8,), discount=0.9))
    trainer = L.Trainer(logger=False, enable_progress_bar=False, enable_model_summary=False)
    (logged,) = trainer.validate(agent, data, verbose=False)
    rows = Transitions(data.dataset, discount=0.9)[torch.arange(len(data.dataset))]
    scale = rows["returns"].std(correction=0).item()  # Q counts in this unit, the metrics in the data's
    q = scale * agent.critics(rows["observations"], rows["actions"]).min(0).values.detach().numpy()
    returns, action = rows["returns"].numpy(), agent.average_actor.act(rows["observations"]).numpy()
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


# published folders


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


@pytest.mark.parametrize("algorithm", ["combo", "et_cql", "et_cql_paper"])
def test_agents_that_imagine_are_refused(algorithm: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sentence = refused(capsys, "agent", "fit", NO_LOGGER, f"--model.algorithm={algorithm}")
    assert f"{algorithm} needs a world model" in sentence and "train_policy" in sentence
    assert "world_model is transformer" in refused(capsys, "agent", "fit", NO_LOGGER, world_model="transformer")


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


def test_a_model_is_of_the_kind_of_what_it_starts_from(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit_ensemble("--model.kind=ensemble")
    Path(".envtf/published").rename("first")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    still = {"weight_decay": [0, 0], "learning_rate": STILL, "batch_size": 8}
    for number, word in enumerate(("--model.init_from=first", "--model.init_from first")):
        shutil.rmtree(".envtf/published", ignore_errors=True)
        envtf("model", "fit", NO_LOGGER, "--config=finetune", *word.split(), "--trainer.max_epochs=1", **still)
        first, second = load_world_model("first"), load_world_model(".envtf/published")
        assert isinstance(second, EnsembleDynamics) and same(first.weights, second.weights), number
    Path("start.yaml").write_text("model: {init_from: first}")
    envtf("model", "fit", NO_LOGGER, "--config=start.yaml", "--trainer.max_epochs=1", **still)
    assert isinstance(load_world_model(".envtf/published"), EnsembleDynamics)
    for start in ("--model.init_from=first", f"--ckpt_path={checkpoint}"):
        for other in ("--model.kind=transformer", "--model.kind transformer"):
            sentence = refused(capsys, "model", "fit", NO_LOGGER, start, *other.split())
            assert "--model.kind is transformer" in sentence and "give --model.kind ensemble" in sentence
    assert "give --model.algorithm cql" in agent_of_another_algorithm(capsys)


def agent_of_another_algorithm(capsys: pytest.CaptureFixture[str]) -> str:
    fit("agent", "--trainer.default_root_dir=agents")
    (checkpoint,) = Path("agents").rglob("*.ckpt")
    return refused(capsys, "agent", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", "--model.algorithm=bc")


@pytest.mark.parametrize(
    ("flags", "kind"),
    [
        ([], None),
        (["--model.kind", "ensemble"], "ensemble"),
        (["--model.kind=ensemble", "--model.kind=transformer"], "transformer"),
        (["--config=own.yaml"], "ensemble"),
        (["-c", "below.yaml"], "ensemble"),
        (["--config", "own.yaml", "--model.kind=transformer"], "transformer"),
        (["--model.kind=transformer", "--config", "own.yaml"], "ensemble"),
        (["--config", "null.yaml"], None),
        (["--config", "odd.yaml"], None),
        (["--config", "missing.yaml", "--model.kindness=x"], None),
    ],
)
def test_what_is_given_is_found_in_flags_and_files(
    flags: list[str], kind: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text("model: {kind: ensemble}")
    Path("below.yaml").write_text("fit: {model: {kind: ensemble}}\nvalidate: {model: {kind: transformer}}")
    Path("null.yaml").write_text("model: {kind: null}")
    Path("odd.yaml").write_text("model: [")
    assert given("model.kind", ["fit", *flags]) == kind


@pytest.mark.parametrize("place", ["--model.kin=ensemble", '--model={"kind": "ensemble"}'])
def test_a_kind_that_is_given_elsewhere_is_refused(
    place: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "give the flag --model.kind" in refused(capsys, "model", "fit", NO_LOGGER, place)
    assert "did you mean 'ensemble'?" in refused(capsys, "model", "fit", NO_LOGGER, "--model.kind=ensembel")


def test_model_fit_publishes_and_starts_from_published_weights(folder: Path) -> None:
    fit("model")
    Path(".envtf/published").rename("first")
    fit("model", "--model.init_from=first", learning_rate=STILL)
    first, second = load_world_model("first"), load_world_model(".envtf/published")
    assert same(first, second)  # the scale of the same data changes no bit
    save_dataset(walker_dataset(seed=1), "data/dataset.h5")
    fit("model", "--model.init_from=first", learning_rate=STILL)
    second = load_world_model(".envtf/published")
    assert same(first.blocks, second.blocks)
    assert not torch.equal(first.normaliser.observation_mean, second.normaliser.observation_mean)
    assert not torch.equal(first.laplace.root, second.laplace.root)  # the posterior is that of the new data
    inputs = torch.randn(2, 3, 11), torch.randn(2, 3, 3)
    outcomes = [model.normaliser.outcome(inputs[0], model(*inputs)[0]) for model in (first, second)]
    torch.testing.assert_close(outcomes[1], outcomes[0], rtol=1e-3, atol=1e-4)
    fit("model", "--model.init_from=first")
    assert not same(first.blocks, load_world_model(".envtf/published").blocks)


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


def test_another_robots_model_keeps_the_frozen_trunk_and_needs_no_flag_for_the_architecture(folder: Path) -> None:
    fit("model")
    Path(".envtf/published").rename("first")
    another_robot()
    budget = {"batch_size": 8, **RUN["model"]}
    envtf("model", "fit", NO_LOGGER, "--model.init_from=first", "--model.freeze=[blocks, norm]", **budget)
    first, second = load_world_model("first"), load_world_model(".envtf/published")
    assert (second.observation_dim, second.action_dim, second.options) == (8, 2, first.options)
    assert same(first.blocks, second.blocks) and same(first.norm, second.norm)
    envtf("model", "fit", NO_LOGGER, "--model.init_from=first", **budget)
    assert not same(first.blocks, load_world_model(".envtf/published").blocks)


def test_another_robots_policy_keeps_the_frozen_hidden_layers(folder: Path) -> None:
    fit("agent", hidden=[8, 8])
    Path(".envtf/published").rename("first")
    another_robot()
    budget = {"batch_size": 8, "warm_start": 0.5, **RUN["agent"]}
    envtf("agent", "fit", NO_LOGGER, "--model.init_from=first", "--model.freeze=[net.2]", **budget)
    first, second = load_policy("first"), load_policy(".envtf/published")
    assert second.arguments["observation_dim"] == 8 and second.arguments["hidden"] == [8, 8]
    assert same(first.net[2], second.net[2]) and not torch.equal(first.net[2].weight, torch.zeros(8, 8))


@pytest.mark.parametrize(
    ("kind", "options", "sentence"),
    [
        ("model", {"updates": 5}, "model.options.updates is 5: take a multiple of its updates_per_epoch (2)"),
        ("model", {"width": 6}, "model.options.width is 6 and heads is 2"),
        ("ensemble", {"weight_decay": [0]}, "model.options.weight_decay has 1 entries and there are 2"),
        ("ensemble", {"elites": 4}, "model.options.elites is 4 and members is 3"),
        ("agent", {"updates_per_epoch": 1}, "model.options.updates_per_epoch is 1: take a multiple of 10"),
        ("agent", {"updates": 25}, "model.options.updates is 25: take a multiple of its updates_per_epoch (10)"),
    ],
)
def test_options_are_held_to_the_rules_of_params(
    kind: str, options: dict[str, object], sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if kind == "ensemble":
        with pytest.raises(SystemExit):
            fit_ensemble("--model.kind=ensemble", **options)
        assert sentence in capsys.readouterr().err
    else:
        assert sentence in refused(capsys, kind, "fit", NO_LOGGER, **{**SIZES[kind], **RUN[kind], **options})
    assert not Path(".envtf").exists()


@pytest.mark.parametrize(
    ("kind", "option", "value", "rule"),
    [
        ("model", "updates_per_epoch", 0, "v>0"),
        ("model", "context", 0, "v>0"),
        ("model", "dropout", 1.0, "v<1"),
        ("model", "layers", 1.5, "invalid literal"),
        ("agent", "updates_per_epoch", 0, "v>0"),
        ("agent", "warm_start", 1.0, "v<1"),
        ("agent", "hidden", [0], "v>0"),
    ],
)
def test_options_are_held_to_the_ranges_of_params(
    kind: str, option: str, value: object, rule: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        fit(kind, **{option: value})
    said = capsys.readouterr().err
    assert stop.value.code == 2 and f"model.options.{option}" in said and rule in said and "Traceback" not in said
    assert not Path(".envtf").exists()


def test_a_negative_seed_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "model.seed is -1, expected an integer, 0 or more" in refused(capsys, "model", "fit", "--model.seed=-1")


def test_a_share_of_held_out_episodes_is_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, share in (("model", "0"), ("model", "1"), ("agent", "1.5"), ("agent", "-0.1")):
        assert "data.held_out is" in refused(capsys, kind, "fit", f"--data.held_out={share}")


def test_the_command_lines_defaults_are_the_pipelines(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert printed_config(capsys, "model")["data"]["held_out"] == DownloadOptions().held_out
    agent = printed_config(capsys, "agent")
    assert agent["data"]["held_out"] == 0.0  # all rows, as for a robot whose simulator can score it
    assert agent["model"]["options"] == json.loads(json.dumps(asdict(CQLOptions())))


def printed_config(capsys: pytest.CaptureFixture[str], kind: str) -> dict[str, Any]:
    with pytest.raises(SystemExit) as stop:
        envtf(kind, "validate", "--print_config")
    assert stop.value.code == 0
    return YAML(typ="safe", pure=True).load(capsys.readouterr().out)


def test_data_take_what_the_options_say(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, Any] = {}

    def note(data: WindowData | TransitionData, stage: str) -> None:
        seen.update(vars(data))
        raise UserError("That is enough.")

    for cls in (WindowData, TransitionData):
        monkeypatch.setattr(cls, "setup", note)
    for flags, expected in (
        (["model", "--model.options.context=3"], {"context": 3, "members": None, "updates_per_epoch": 1_000}),
        (["model", "--model.options.batch_size=8", "--model.seed=2"], {"batch_size": 8, "seed": 2, "share": 0.1}),
        (["model", "--model.kind=ensemble"], {"context": 1, "members": 7, "batch_size": 256}),
        (["agent", "--model.options.discount=0.5", "--model.options.n_step=3"], {"discount": 0.5, "n_step": 3}),
        (["agent", "--model.seed=2"], {"return_temperature": 0.1, "steps_per_epoch": 50, "seed": 2}),
        (["agent", "--model.options.return_temperature=null"], {"return_temperature": None, "batch_size": 256}),
    ):
        seen.clear()
        with pytest.raises(SystemExit):
            envtf(flags[0], "fit", NO_LOGGER, *flags[1:])
        assert {name: seen[name] for name in expected} == expected, flags


PLAIN = (dict, list, tuple, int, float, bool, str, type(None))


def all_types(tree: Any) -> set[type]:
    below = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list | tuple) else ()
    return {type(tree)}.union(*(all_types(item) for item in below))


@pytest.mark.parametrize("kind", ["transformer", "ensemble", "cql", "bc"])
def test_checkpoints_hold_options_as_plain_numbers(kind: str, folder: Path) -> None:
    if kind == "ensemble":
        fit_ensemble("--model.kind=ensemble")
    elif kind == "transformer":
        fit("model")
    else:
        fit("agent", f"--model.algorithm={kind}")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    saved = torch.load(checkpoint, weights_only=False)["hyper_parameters"]
    assert all_types(saved) <= set(PLAIN) and saved["options"]["batch_size"] == 8


@pytest.mark.parametrize(
    ("kind", "parts", "sentence"),
    [
        ("model", "[block]", "no part 'block' to freeze: did you mean 'blocks'?"),
        ("model", "[embed, blocks, norm, head]", "leaves nothing to train"),
        ("agent", "[nets]", "no part 'nets' to freeze"),
    ],
)
def test_what_cannot_be_frozen_is_refused(
    kind: str, parts: str, sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sentence in refused(
        capsys, kind, "fit", NO_LOGGER, f"--model.freeze={parts}", **{**SIZES[kind], **RUN[kind]}
    )


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
    fit("agent", "--model.init_from=first", "--model.seed=1", warm_start=0.99)  # of 20 updates all
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


# checkpoints


@pytest.mark.parametrize("kind", ["model", "agent"])
def test_a_continued_run_keeps_the_checkpoints_options_where_no_flag_differs(kind: str, folder: Path) -> None:
    fit(kind, "--model.seed=3")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    longer_by_two = 2 * RUN[kind]["updates"]
    envtf(kind, "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", updates=longer_by_two)
    (longer,) = set(Path(".envtf").rglob("*.ckpt")) - {checkpoint}
    before, after = (torch.load(path, weights_only=True) for path in (checkpoint, longer))
    assert (before["epoch"], after["epoch"]) == (1, 3)
    assert after["hyper_parameters"].pop("options") == before["hyper_parameters"].pop("options") | {
        "updates": longer_by_two
    }
    assert after["hyper_parameters"] == before["hyper_parameters"] and before["hyper_parameters"]["seed"] == 3


def written() -> dict[str, bytes]:
    """Name and bytes of every file that fit published."""
    return {path.name: path.read_bytes() for path in sorted(Path(".envtf/published").iterdir())}


@pytest.mark.parametrize("kind", ["model", "agent"])
@pytest.mark.parametrize("tuned", [False, True])
def test_a_continued_run_equals_an_uninterrupted_one(kind: str, tuned: bool, folder: Path) -> None:
    flags, options = [], {}
    if tuned:
        fit(kind)
        shutil.move(".envtf/published", "base")
        shutil.rmtree(".envtf")
        save_dataset(walker_dataset(seed=1), "data/dataset.h5")
        part = {"model": "blocks", "agent": "net.0"}[kind]
        flags = ["--model.init_from=base", f"--model.freeze=[{part}]"]
        options = {"agent": {"warm_start": 0.75}, "model": {}}[kind]  # the kill is in the warm-up
    fit(kind, "--trainer.max_epochs=1", *flags, **options)
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    if tuned:
        Path("base").rename("elsewhere")  # a continued run needs it no more
    envtf(kind, "fit", NO_LOGGER, f"--ckpt_path={checkpoint}")
    resumed = written()
    if tuned:
        Path("elsewhere").rename("base")
    fit(kind, *flags, **options)
    assert written() == resumed


def test_model_test_equals_validate_and_needs_no_options_beside_the_checkpoint(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit("model")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    numbers = {}
    for verb, prefix in (("validate", "val"), ("test", "test")):
        capsys.readouterr()
        envtf("model", verb, NO_LOGGER, f"--ckpt_path={checkpoint}")
        words = capsys.readouterr().out.replace("│", " ").split()
        numbers[verb] = [words[words.index(f"{prefix}/{name}") + 1] for name in ("loss", "open_loop_error")]
    assert numbers["validate"] == numbers["test"] and float(numbers["test"][0]) > 0


def test_checkpoints_that_do_not_fit_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit("model")
    (checkpoint,) = Path(".envtf").rglob("*.ckpt")
    assert "does not exist" in refused(capsys, "model", "fit", "--ckpt_path=nowhere.ckpt")
    assert "not a checkpoint" in refused(capsys, "model", "fit", "--ckpt_path=data/dataset.h5")
    changed = refused(capsys, "model", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}", width=8)
    assert "does not fit the model" in changed and "change the architecture" in changed
    assert "not a checkpoint" in refused(capsys, "agent", "fit", NO_LOGGER, f"--ckpt_path={checkpoint}")
    saved = torch.load(checkpoint, weights_only=True)
    options = saved["hyper_parameters"]["options"]  # as they were nested until version 0.1
    saved["hyper_parameters"]["options"] = {"model": options, "ensemble": None, "held_out": 0.1, "updates": 4}
    torch.save(saved, "older.ckpt")
    older = refused(capsys, "model", "fit", NO_LOGGER, "--ckpt_path=older.ckpt")
    assert "older.ckpt is not a checkpoint of this model (Unknown option 'model' in options" in older


def test_folders_of_an_older_layout_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fit("model")
    Path("models").mkdir()
    Path(".envtf/published").rename("models/world_model")
    config = read_json("models/world_model/config.json")
    config["arguments"]["memory"] = 4
    write_json("models/world_model/config.json", config)
    sentence = refused(capsys, "model", "fit", NO_LOGGER, "--model.init_from=models/world_model")
    assert "models/world_model/config.json: Unknown option 'memory' in arguments" in sentence


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


# loggers


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
