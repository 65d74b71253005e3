"""The models that are compared: trained once with the same settings, and anew with others."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from envtf_lit import load_world_model
from envtf_lit.errors import UserError
from envtf_lit.robots.tasks import get_task
from envtf_lit.studies import suite as suite_module
from envtf_lit.studies.suite import MODELS, SuiteOptions, add_model, build_suite, other_folders
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.options import EnsembleOptions, TransformerOptions
from envtf_lit.world_models.store import save_world_model
from envtf_lit.world_models.transformer import EnvironmentTransformer

ENSEMBLE = EnsembleOptions(
    members=3, elites=2, hidden=(8,), weight_decay=(0.0, 0.0), updates=4, updates_per_epoch=2, batch_size=8
)
TINY = SuiteOptions(transitions=1_000, updates=2, ensemble=ENSEMBLE, threads=1)


@pytest.mark.filterwarnings("ignore:.*treespec, LeafSpec:FutureWarning")
def test_a_suite_is_trained_once_and_what_changed_is_trained_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_models: None
) -> None:
    suite = build_suite("hopper-medium", tmp_path, TINY, progress=False)
    assert tuple(suite.folders) == MODELS == tuple(suite.seconds)
    transformer, context_1, ensemble = (load_world_model(folder) for folder in suite.folders.values())
    assert isinstance(transformer, EnvironmentTransformer) and transformer.options.context > 1
    assert isinstance(context_1, EnvironmentTransformer) and context_1.options.context == 1
    assert isinstance(ensemble, EnsembleDynamics) and ensemble.members == 3
    training, _, held_out = suite.split()
    assert len(training) > 500 and len(held_out) > 0

    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.safetensors")}
    assert build_suite("hopper-medium", tmp_path, TINY, progress=False) == suite
    record = tmp_path / "hopper-medium/models/transformer.json"
    older = json.loads(record.read_text())
    del older["settings"]["train_model"]["bounded"]  # as if written before there was that option
    record.write_text(json.dumps(older))
    origin = json.loads((tmp_path / "hopper-medium/data.json").read_text())
    for path in (record, tmp_path / "hopper-medium/data.json"):  # as if written before datasets were told apart
        content = json.loads(path.read_text())
        for name in ("dataset", "origin"):
            content["settings"].pop(name, None)
        path.write_text(json.dumps(content))
    assert build_suite("hopper-medium", tmp_path, TINY, progress=False) == suite
    options = TransformerOptions(layers=1, heads=1, width=8, bounded=True, updates=2, updates_per_epoch=2)
    add_model(suite, "bounded", options, progress=False)
    bounded = load_world_model(suite.folders["bounded"])
    assert isinstance(bounded, EnvironmentTransformer) and bounded.options.bounded
    assert suite.costs["hopper.bounded.train_seconds"] > 0
    assert suite.costs["hopper.bounded.updates"] == 2 and suite.costs["hopper.ensemble.updates"] == 4
    changed = replace(TINY, ensemble=replace(ENSEMBLE, hidden=(9,)))
    build_suite("hopper-medium", tmp_path, changed, progress=False)
    anew = {path for path, time in written.items() if path.stat().st_mtime_ns != time}
    assert anew == {suite.folders["ensemble"] / "weights.safetensors"}
    (trained,) = anew
    time = trained.stat().st_mtime_ns
    build_suite("hopper-medium", tmp_path, replace(changed, updates=3, context=2), models=["ensemble"], progress=False)
    assert trained.stat().st_mtime_ns == time  # the others' budgets are not its own

    old = json.loads(record.read_text())
    del old["settings"]["format"]  # as if written when transformers were saved otherwise
    record.write_text(json.dumps(old))
    build_suite("hopper-medium", tmp_path, TINY, models=["transformer"], progress=False)
    assert (suite.folders["transformer"] / "weights.safetensors").stat().st_mtime_ns > time

    calls = list[str]()
    monkeypatch.setattr(suite_module, "download", lambda *arguments, **options: calls.append("data"))
    monkeypatch.setattr(suite_module, "_train", lambda *arguments: calls.append("model"))
    os.utime(record)
    card = tmp_path / "hopper-medium/data/dataset.json"
    returned = origin["settings"]["origin"]["policies"][0]["mean_return_deterministic"]
    card.write_text(card.read_text().replace(str(returned), "1.5"))  # as if by another zoo's policy
    build_suite("hopper-medium", tmp_path, TINY, models=["transformer"], progress=False)
    assert calls == ["data"]  # its record was one of before: the card told
    with suite.dataset.open("ab") as stream:
        stream.write(b"other bytes")
    build_suite("hopper-medium", tmp_path, TINY, models=["transformer", "context_1"], progress=False)
    assert calls == ["data", "model", "model"]


def test_unknown_models_and_bad_budgets_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="did you mean 'ensemble'"):
        build_suite("hopper-medium", tmp_path, TINY, models=["ensembles"], progress=False)
    with pytest.raises(UserError, match=r"updates is 1500: take a multiple of its updates_per_epoch \(1000\)"):
        build_suite("hopper-medium", tmp_path, replace(TINY, updates=1_500), progress=False)
    with pytest.raises(UserError, match="elites is 4 and members is 3"):
        build_suite("hopper-medium", tmp_path, replace(TINY, ensemble=replace(ENSEMBLE, elites=4)), progress=False)
    for option, value in (("updates", 0), ("context", 0), ("threads", 0), ("transitions", 5), ("seed", -1)):
        with pytest.raises(UserError, match=rf"{option} is {value}, expected an integer"):
            build_suite("hopper-medium", tmp_path, replace(TINY, **{option: value}), progress=False)
    assert list(tmp_path.iterdir()) == []


def test_further_models_are_checked_by_name_and_robot(tmp_path: Path) -> None:
    hopper, walker = get_task("hopper-medium"), get_task("walker2d-medium")
    for task in (hopper, walker):
        robot = task.robot
        model = EnsembleDynamics(robot.observation_dim, robot.action_dim, members=1, elites=1, hidden=(4,))
        save_world_model(tmp_path / task.name / robot.name, model)
    found = other_folders({"mine": f"{tmp_path}/{{task}}/{{robot}}"}, [hopper, walker])
    assert found["walker2d-medium"] == {"mine": tmp_path / "walker2d-medium/walker2d"}
    with pytest.raises(UserError, match=r"hopper-medium/hopper holds a world model of another robot: .* walker2d\."):
        other_folders({"mine": f"{tmp_path}/hopper-medium/hopper"}, [hopper, walker])
    with pytest.raises(UserError, match="nowhere is not a model folder"):
        other_folders({"mine": f"{tmp_path}/nowhere"}, [hopper])
    for name in ("context_1", "physics", "a.b"):
        with pytest.raises(UserError, match=f"cannot be called {name!r}"):
            other_folders({name: str(tmp_path)}, [hopper])
