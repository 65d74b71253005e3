"""dvc.yaml against params.yaml, the commands, and what the stages' code really imports."""

import ast
import json
import re
import shlex
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import grimp
import pytest
from ruamel.yaml import YAML

from envtf_lit.cli.stages import STAGES, StageParser, split
from envtf_lit.pipeline.params import Params, kind_of
from envtf_lit.pipeline.stage import NOTHING
from envtf_lit.pipeline.yaml import load_params

ROOT = Path(__file__).parent.parent
# every stage reads its options through these, and DVC tracks the options' values themselves
OPTIONS = {"envtf_lit.errors", "envtf_lit.pipeline.params"}


def read_yaml(name: str) -> dict[str, Any]:
    return YAML(typ="safe", pure=True).load(ROOT / name)


@cache
def stages(added: str = "") -> dict[str, dict[str, Any]]:
    """dvc.yaml's stages by their full names, each foreach over a section of params.yaml written out.

    Args:
        added: a section that params.yaml has beside its own, such as `train_policy.x: {…}`.
    """
    written, params = {}, read_yaml("params.yaml")
    for key, values in YAML(typ="safe", pure=True).load(added or "{}").items():
        stage, name = key.split(".")
        params[stage][name] = values
    for name, stage in read_yaml("dvc.yaml")["stages"].items():
        if "foreach" not in stage:
            written[name] = filled(stage, params)
            continue
        for key, item in params[stage["foreach"][2:-1]].items():
            written[f"{name}@{key}"] = filled(stage["do"], params | {"key": key, "item": item})
    return written


def filled(stage: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """A stage, or another part of dvc.yaml, with the values of its `${a.b}`."""

    def value(match: re.Match[str]) -> str:
        found: Any = values
        for name in match[1].split("."):
            found = found[name]
        return str(found)

    return json.loads(re.sub(r"\$\{([\w.]+)\}", value, json.dumps(stage)))


@cache
def all_params() -> Params:
    return load_params(ROOT / "params.yaml")


def test_every_stage_is_a_command_and_a_function() -> None:
    names = [name.partition("@")[0] for name in stages()]
    assert list(dict.fromkeys(names)) == list(STAGES)
    for name, stage in stages().items():
        program, command, *words = shlex.split(stage["cmd"])
        own, overrides = split(words)
        assert (program, command, overrides) == ("envtf", name.partition("@")[0], [])
        parsed = StageParser(command).parse_args(own)
        assert parsed.params == "params.yaml"
        if STAGES[command].named:
            assert name == f"{command}@{parsed.name}"
        assert callable(getattr(import_module(f"envtf_lit.pipeline.{command}"), command))


def test_every_tracked_option_is_in_params_yaml() -> None:
    for stage in stages().values():
        tracked = stage.get("params", [])
        assert len(tracked) == len(set(tracked))
        for key in tracked:
            tree = read_yaml("params.yaml")
            for name in key.split("."):
                assert name in tree, key
                tree = tree[name]


def test_every_option_is_tracked_by_some_stage() -> None:
    tracked = {key for stage in stages().values() for key in stage.get("params", [])}
    top = {key.partition(".")[0] for key in tracked}
    assert top == read_yaml("params.yaml").keys()
    for stage in ("train_model", "train_policy"):
        assert {f"{stage}.{name}" for name in read_yaml("params.yaml")[stage]} <= tracked


def made(stage: dict[str, Any]) -> set[str]:
    """What a stage reads of others' outputs."""
    return {path for path in stage.get("deps", []) if path.split("/")[0] in ("data", "models", "reports")}


def test_policies_from_data_alone_depend_on_no_world_model_and_no_rollouts() -> None:
    nothing = {"models/world_model/none", "data/rollouts/none.h5"}  # which `source` writes
    for name in ("bc", "cql"):
        assert made(stages()[f"train_policy@{name}"]) == {"data/dataset.h5"} | nothing
        assert [key for key in stages()[f"train_policy@{name}"]["params"] if "et_cql" in key or "model" in key] == []
    assert nothing == {str(path) for path in NOTHING} <= set(stages()["source"]["outs"])
    imagined = {"models/world_model/transformer", "data/rollouts/transformer.h5"}
    assert made(stages()["train_policy@et_cql"]) == {"data/dataset.h5"} | imagined


STRONG = "cql_strong: {algorithm: cql, world_model: none, cql_weight: 1}"
SEVEN = "seven: {kind: ensemble, members: 7}"


def test_another_policy_is_another_section_and_nothing_else() -> None:
    more = stages(f"train_policy.{STRONG}")
    assert more.keys() - stages().keys() == {"train_policy@cql_strong"}
    added, cql = more["train_policy@cql_strong"], more["train_policy@cql"]
    assert (added["cmd"], added["outs"]) == ("envtf train_policy cql_strong", ["models/policy/cql_strong"])
    assert added["deps"] == cql["deps"]
    assert set(added["params"]) - set(cql["params"]) == {"train_policy.cql_strong"}
    assert {name for name in more if more[name] != stages().get(name)} == {"train_policy@cql_strong"}
    for reader in ("evaluate", "report"):
        assert "models/policy" in more[reader]["deps"]
    assert "train_policy" in more["evaluate"]["params"]
    params = load_params(ROOT / "params.yaml", [f"train_policy={{{STRONG}}}"])
    assert [*params.train_policy] == [*all_params().train_policy, "cql_strong"]
    assert params.train_policy["cql_strong"].updates == params.policy.updates


def test_another_world_model_is_another_section_and_nothing_else() -> None:
    more = stages(f"train_model.{SEVEN}")
    assert more.keys() - stages().keys() == {"train_model@seven", "generate_rollouts@seven"}
    assert {name for name in more if more[name] != stages().get(name)} == more.keys() - stages().keys()
    model, rollouts = more["train_model@seven"], more["generate_rollouts@seven"]
    assert (model["cmd"], model["outs"]) == ("envtf train_model seven", ["models/world_model/seven"])
    assert (rollouts["cmd"], rollouts["outs"]) == ("envtf generate_rollouts seven", ["data/rollouts/seven.h5"])
    assert "train_model.seven" in model["params"]
    assert made(rollouts) == {"data/dataset.h5", "models/world_model/seven", "models/policy/bc"}
    params = load_params(ROOT / "params.yaml", [f"train_model={{{SEVEN}}}", "train_policy.et_cql.world_model=seven"])
    assert kind_of(params.train_model[params.train_policy["et_cql"].world_model]) == "ensemble"


@pytest.mark.parametrize("stage", STAGES)
def test_a_word_changed_in_a_stages_own_file_reruns_no_other_stage(stage: str) -> None:
    """And so does, in those of report, a word changed in what reports alone are made of."""
    own = {f"envtf_lit/pipeline/{stage}.py"} | (
        {"notebooks/report.ipynb", "envtf_lit/figures/notebook.py"} if stage == "report" else set()
    )
    for path in own:
        assert (ROOT / path).is_file()
        readers = {name.partition("@")[0] for name, found in stages().items() if depends(found, path)}
        assert readers == {stage}


def depends(stage: dict[str, Any], path: str) -> bool:
    return bool({path, *map(str, Path(path).parents)} & set(stage["deps"]))


def test_what_a_stage_reads_another_writes() -> None:
    outputs = {path for stage in stages().values() for path in stage["outs"]}
    for stage in stages().values():
        assert {path for path in made(stage) if not any(f"{out}/".startswith(f"{path}/") for out in outputs)} == set()


def test_what_plots_and_artifacts_name_a_stage_writes() -> None:
    pipeline = filled({name: read_yaml("dvc.yaml")[name] for name in ("artifacts", "plots")}, read_yaml("params.yaml"))
    named = [artifact["path"] for artifact in pipeline["artifacts"].values()]
    for plot in pipeline["plots"]:
        named += [plot] if isinstance(plot, str) else [path for found in plot.values() for path in found["y"]]
    outputs = [path for stage in stages().values() for path in stage["outs"]]
    assert len(named) > 5
    inside = [path for path in named if any(f"{path}/".startswith(f"{out}/") for out in outputs)]
    around = {path for path in named if any(f"{out}/".startswith(f"{path}/") for out in outputs)}
    assert set(named) - {*inside} <= around == {"models/world_model/transformer", "models/policy"}


def test_code_that_stages_name_exists() -> None:
    for stage in stages().values():
        assert [
            path for path in stage["deps"] if path.startswith(("envtf_lit", "notebooks")) and not (ROOT / path).exists()
        ] == []


# each stage's dependencies against its imports


@cache
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("envtf_lit")


def imported_names(node: ast.AST) -> set[str]:
    """The package's modules that the import statements below a syntax node name."""
    names = set()
    for statement in ast.walk(node):
        if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("envtf_lit"):
            inner = {f"{statement.module}.{alias.name}" for alias in statement.names}
            names |= inner & imports().modules or {str(statement.module)}
    return names


def is_options(module: str) -> bool:
    return module in OPTIONS or module.endswith(".options") or module.startswith("envtf_lit.options.")


def modules_of(stage: str) -> set[str]:
    """All modules of the package that a stage's file imports, directly or through others, but for the options."""
    direct = {f"envtf_lit.pipeline.{stage.partition('@')[0]}"}
    for path in stages()[stage]["deps"]:
        if path.endswith(".ipynb"):
            cells = json.loads((ROOT / path).read_text())["cells"]
            code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
            direct |= imported_names(ast.parse("\n".join(code)))
    reached, waiting = set(), list(direct)
    while waiting:
        module = waiting.pop()
        reached.add(module)
        following = {name for name in imports().find_modules_directly_imported_by(module) if not is_options(name)}
        waiting += following - reached
    packages = {module for module in reached if imports().find_children(module)}
    return reached - packages


@pytest.mark.parametrize("stage", stages())
def test_a_stage_depends_on_the_code_it_imports_and_no_other(stage: str) -> None:
    declared = {path for path in stages()[stage]["deps"] if path.startswith("envtf_lit/")} - {"envtf_lit/assets/zoo"}
    needed = {f"{module.replace('.', '/')}.py" for module in modules_of(stage)}
    missing = {path for path in needed if not declared & {path, *map(str, Path(path).parents)}}
    idle = {path for path in declared if path not in needed and not any(p.startswith(f"{path}/") for p in needed)}
    assert (missing, idle) == (set(), set())
