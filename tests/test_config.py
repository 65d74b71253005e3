"""params.yaml in and out: presets, what is written, and what is read from it."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from envtf_lit.agents.options import CommonOptions
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.errors import UserError
from envtf_lit.options.schema import build, build_tagged, kind, rebuild
from envtf_lit.pipeline.params import COMMON, Params, algorithm_of, build_params, kind_of, one_of
from envtf_lit.pipeline.yaml import (
    NAMED,
    PRESETS,
    describe,
    dump_params,
    load_params,
    meanings,
    params_yaml,
    preset_params,
)
from envtf_lit.world_models.options import KINDS, TransformerOptions

ROOT = Path(__file__).parent.parent
TAGGED = {"algorithm": {name: algorithm.Options for name, algorithm in ALGORITHMS.items()}, "kind": KINDS}


def options_classes() -> list[type]:
    """`Params`, and every options class at any depth below it."""
    found, waiting = list[type](), [Params, *KINDS.values(), *TAGGED["algorithm"].values()]
    while waiting:
        cls = waiting.pop()
        if cls not in found:
            found.append(cls)
            waiting += [
                x
                for hint in get_type_hints(cls).values()
                for x in (hint, *get_args(hint))
                if isinstance(x, type) and dataclasses.is_dataclass(x)
            ]
    return found


def numbers(hint: Any) -> Iterator[type]:
    """The number types within an annotation."""
    for x in (hint, *get_args(hint)):
        if isinstance(x, type) and issubclass(x, int | float) and x is not bool:
            yield x


def leaves(values: Any, key: str = "") -> dict[str, Any]:
    if not isinstance(values, dict):
        return {key: values}
    return {k: v for name, item in values.items() for k, v in leaves(item, f"{key}.{name}" if key else name).items()}


def load(tmp_path: Path, text: str, *overrides: str) -> Params:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return load_params(path, overrides)


# presets and what is written


def test_small_is_the_code_defaults() -> None:
    assert preset_params("small") == Params()


def test_the_repositorys_params_yaml_is_the_small_preset() -> None:
    assert (ROOT / "params.yaml").read_text() == params_yaml(preset_params("small"))


def test_the_repositorys_params_yaml_is_short() -> None:
    """Of options that many change, one a line."""
    lines = re.findall(r"^ *[\w]+: (?! *#)\S.*$", (ROOT / "params.yaml").read_text(), re.MULTILINE)
    assert 50 < len(lines) <= 70
    assert set(leaves(YAML(typ="safe", pure=True).load(ROOT / "params.yaml"))) <= set(leaves(dump_params(Params())))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_written_preset_reads_back_the_same(preset: str, tmp_path: Path) -> None:
    text = params_yaml(preset_params(preset))
    assert load(tmp_path, text) == preset_params(preset)


def test_papers_preset_has_the_published_settings() -> None:
    params = preset_params("paper")
    model, cql, policy = params.train_model["transformer"], params.train_policy["cql"], params.train_policy["et_cql"]
    assert isinstance(model, TransformerOptions)
    assert (model.layers, model.heads, model.width, model.context, model.dropout) == (8, 16, 1024, 100, 0.1)
    assert (model.activation, model.objective, model.target) == ("relu", "paper_mse", "absolute")
    assert (model.batch_size, model.learning_rate, model.weight_decay, model.eps) == (16, 1e-4, 1e-4, 1e-4)
    assert (algorithm_of(cql), algorithm_of(policy)) == ("cql", "et_cql_paper")
    own: Any = policy
    assert (own.updates, own.hidden, own.sampled_actions) == (1_000_000, (256, 256, 256), 10)
    assert (own.world_model, own.real_ratio, own.refresh_every) == ("transformer", 0.5, 0)
    assert (own.rollouts.horizon, own.rollouts.penalty, own.rollouts.value_expansion) == (5, 0.0, 0)
    assert not hasattr(own, "value_gradient")


def test_written_numbers_mean_the_same_to_yaml_1_1_readers() -> None:
    assert not re.search(r": [\d.]+e", params_yaml(preset_params("paper")))


def test_rare_options_are_written_only_where_they_differ(tmp_path: Path) -> None:
    rare = {field.name for cls in options_classes() for field in dataclasses.fields(cls) if field.metadata.get("rare")}
    assert len(rare) > 10
    hidden = (
        leaves(dump_params(Params())).keys() - leaves(YAML(typ="safe", pure=True).load(params_yaml(Params()))).keys()
    )
    assert {key.rpartition(".")[2] for key in hidden} == rare
    changed = load(tmp_path, "", "train_policy.cql.sampled_actions=7", "policy.target_rate=0.5")
    text = params_yaml(changed)
    assert re.findall(r"^.*(?:sampled_actions|target_rate).*$", text, re.MULTILINE) == [
        "  target_rate: 0.5  # share of the critics that enters the target networks at each update",
        "    sampled_actions: 7  # actions of each kind (uniform, pi(s), pi(s')) in the log-sum-exp",
    ]
    assert load(tmp_path, text) == changed


def test_an_option_that_comes_twice_is_explained_once() -> None:
    lines = re.findall(r"^ *cql_weight: .*$", params_yaml(Params()), re.MULTILINE)
    assert lines == [
        "    cql_weight: 0.1  # weight of the conservative term, beside half of the squared error",
        "    cql_weight: 0.01",
    ]


def test_every_option_is_explained() -> None:
    for cls in options_classes():
        assert meanings(cls).keys() == get_type_hints(cls).keys()
        assert all(meanings(cls).values())


def test_every_number_has_a_range() -> None:
    """In its annotation."""
    found = {
        (cls.__name__, name): [*numbers(hint)]
        for cls in options_classes()
        for name, hint in get_type_hints(cls).items()
    }
    assert sum(map(bool, found.values())) > 50
    assert [key for key, types in found.items() if any(not hasattr(x, "_restrictions") for x in types)] == []


@pytest.mark.parametrize("section", ["train_policy.et_cql", "train_model.transformer", "policy", "download"])
def test_describe_lists_every_option_of_a_section(section: str) -> None:
    """The rare ones, too; but for the tag, which the section's name stands for."""
    tree = dump_params(Params())
    for name in section.split("."):
        tree = tree[name]
    expected = leaves({key: value for key, value in tree.items() if key not in NAMED.values()}, section)
    assert {option.key: option.default for option in describe(section)} == expected
    assert all(option.kind and option.meaning for option in describe(section))


def test_help_says_types_and_ranges_in_words() -> None:
    kinds = {option.key.rpartition(".")[2]: option.kind for part in ("policy", "evaluate") for option in describe(part)}
    assert kinds["hidden"] == "list of int, more than 0"
    assert (kinds["discount"], kinds["actor_average"]) == ("float, in [0, 1)", "float, in (0, 1]")
    assert (kinds["return_temperature"], kinds["video_frames"]) == ("float, more than 0 | null", "int, in [2, 150]")
    assert (kinds["layer_norm"], kinds["actor_schedule"], kinds["world_model"]) == ("bool", "constant | cosine", "str")
    assert kind(float) == "float, finite"


# what is read


def test_absent_options_take_their_defaults(tmp_path: Path) -> None:
    params = load(
        tmp_path, "seed: 3\ntrain_policy: {bc: {algorithm: bc}, x: {algorithm: et_cql, rollouts: {history: 2}}}"
    )
    assert params.seed == 3
    defaults: Any = Params().train_policy["et_cql"]
    assert params.train_policy["x"] == dataclasses.replace(
        defaults, rollouts=dataclasses.replace(defaults.rollouts, history=2)
    )
    assert load(tmp_path, "") == Params()


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    params = load(tmp_path, "seed: 3\nthreads: 4", "seed=7", "train_policy.cql.hidden=[8, 8]")
    assert (params.seed, params.threads, params.train_policy["cql"].hidden) == (7, 4, (8, 8))


def test_what_policies_share_is_said_once(tmp_path: Path) -> None:
    """Equal budgets by construction."""
    params = load(tmp_path, "policy: {updates: 9000, discount: 0.9}", "train_policy.cql.discount=0.5")
    assert {options.updates for options in params.train_policy.values()} == {9_000}
    assert {name: options.discount for name, options in params.train_policy.items()} == {
        "bc": 0.9,
        "cql": 0.5,
        "et_cql": 0.9,
    }
    assert dump_params(params)["train_policy"]["cql"].keys() & set(COMMON) == {"discount"}
    default = Params()
    for name, options in default.train_policy.items():
        differing = {key for key in COMMON if getattr(options, key) != getattr(default.policy, key)}
        assert differing == ({"return_temperature"} if name == "bc" else set())


def test_a_policys_own_value_stays_where_the_shared_one_changes(tmp_path: Path) -> None:
    params = load(tmp_path, "train_policy: {bc: {algorithm: bc, updates: 4500}}", "policy.updates=9000")
    assert (params.policy.updates, params.train_policy["bc"].updates) == (9_000, 4_500)
    assert load(tmp_path, params_yaml(params)) == params


def test_sections_below_a_stage_have_names_of_their_own(tmp_path: Path) -> None:
    text = """
train_model:
  wide: {kind: transformer, width: 256}
  seven: {kind: ensemble, members: 7}
train_policy:
  clone: {algorithm: bc}
  dream: {algorithm: combo, world_model: seven, rollouts: {novelty_limit: null}}
generate_rollouts: {policy: clone}
evaluate: {world_model: wide}
"""
    params = load(tmp_path, text)
    assert {name: kind_of(x) for name, x in params.train_model.items()} == {"wide": "transformer", "seven": "ensemble"}
    assert {name: algorithm_of(x) for name, x in params.train_policy.items()} == {"clone": "bc", "dream": "combo"}
    assert load(tmp_path, params_yaml(params)) == params
    assert one_of("train_model", params.train_model, "seven") == "seven"
    assert one_of("train_model", {"wide": 1}, None) == "wide"
    with pytest.raises(UserError, match="train_model has the sections wide, seven: name one of them"):
        one_of("train_model", params.train_model, None)
    with pytest.raises(UserError, match="no section 'wied' below train_model: did you mean 'wide'"):
        one_of("train_model", params.train_model, "wied")


def test_a_homes_tilde_is_meant_as_the_shell_means_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    params = load(tmp_path, "download: {source: file, path: ~/logs/my.h5}")
    assert params.download.path == str(tmp_path / "logs/my.h5")
    assert load(tmp_path, "download: {source: file, path: a~b.h5}").download.path == "a~b.h5"


@pytest.mark.parametrize("text", ["3e-4", "3.0e-04", "0.0003", "0.000_3"])
def test_every_spelling_of_a_number_is_a_number(text: str, tmp_path: Path) -> None:
    assert load(tmp_path, f"policy: {{actor_learning_rate: {text}}}").policy.actor_learning_rate == pytest.approx(3e-4)


def test_a_whole_float_is_a_fine_count(tmp_path: Path) -> None:
    updates = load(tmp_path, "policy: {updates: 1e4}").policy.updates
    assert updates == 10_000
    assert type(updates) is int


@settings(deadline=None)  # the first example pays for imports
@given(st.integers(1, 10**9), st.floats(1e-12, 1e3), st.lists(st.integers(1, 4096), min_size=1, max_size=5))
def test_what_is_written_is_what_was_meant(seed: int, rate: float, hidden: list[int]) -> None:
    policies = {"bc": {"algorithm": "bc"}, "cql": {"algorithm": "cql", "hidden": hidden}}
    tree = {"seed": seed, "policy": {"critic_learning_rate": rate}, "train_policy": policies}
    params = build_params(tree)
    assert build_params(YAML(typ="safe", pure=True).load(params_yaml(params))) == params


@pytest.mark.parametrize(("tag", "name"), [(tag, name) for tag, classes in TAGGED.items() for name in classes])
def test_every_kind_and_algorithm_is_built_from_plain_values(tag: str, name: str) -> None:
    classes: dict[str, type] = dict(TAGGED[tag])
    options = build_tagged(classes, tag, {tag: name}, "x")
    assert type(options) is classes[name]
    plain = YAML(typ="safe", pure=True).load(
        str(dataclasses.asdict(options)).replace("(", "[").replace(")", "]").replace("None", "null")
    )
    assert build(classes[name], plain, "x") == options == rebuild(options)


def test_options_put_together_in_code_are_checked_alike() -> None:
    with pytest.raises(UserError, match=r"^updates is 10: take a multiple of its updates_per_epoch \(500\)\.$"):
        CommonOptions(updates=10)
    with pytest.raises(UserError, match=r"^batch_size is 0, expected an integer, more than 0\.$"):
        rebuild(CommonOptions(batch_size=0))
