"""params.yaml in and out: what is accepted, what is refused and with which words."""

import dataclasses
import re
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from envtf_lit.errors import UserError
from envtf_lit.options.schema import RANGES
from envtf_lit.pipeline.params import Params, build_params
from envtf_lit.pipeline.yaml import PRESETS, describe, dump_params, load_params, meanings, params_yaml, preset_params


def options_classes(cls: type = Params) -> set[type]:
    """`Params` and every options class below it."""
    inner = {x for hint in get_type_hints(cls).values() for x in (hint, *get_args(hint)) if dataclasses.is_dataclass(x)}
    return {cls}.union(*(options_classes(x) for x in inner if isinstance(x, type)))


def leaves(values: Any, key: str = "") -> dict[str, Any]:
    if not isinstance(values, dict):
        return {key: values}
    return {k: v for name, item in values.items() for k, v in leaves(item, f"{key}.{name}" if key else name).items()}


def numeric_fields() -> list[tuple[str, str]]:
    hints = {(cls.__name__, name): hint for cls in options_classes() for name, hint in get_type_hints(cls).items()}
    return sorted(key for key, hint in hints.items() if {int, float} & {hint, *get_args(hint)})


def load(tmp_path: Path, text: str, *overrides: str) -> Params:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return load_params(path, overrides)


def test_small_is_the_code_defaults() -> None:
    assert preset_params("small") == Params()


def test_the_repositorys_params_yaml_is_the_small_preset(repository: Path) -> None:
    assert (repository / "params.yaml").read_text() == params_yaml(preset_params("small"))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_written_preset_reads_back_the_same(preset: str, tmp_path: Path) -> None:
    text = params_yaml(preset_params(preset))
    assert load(tmp_path, text) == preset_params(preset)


def test_papers_preset_has_the_published_settings() -> None:
    train, policy = preset_params("paper").train_model, preset_params("paper").train_policy.et_cql
    model = train.model
    assert (model.layers, model.heads, model.width, model.context, model.dropout) == (8, 16, 1024, 100, 0.1)
    assert (model.activation, model.objective, model.target) == ("relu", "paper_mse", "absolute")
    assert (train.batch_size, train.learning_rate, train.weight_decay, train.eps) == (16, 1e-4, 1e-4, 1e-4)
    assert (policy.updates, policy.hidden, policy.sampled_actions) == (1_000_000, (256, 256, 256), 10)
    assert policy.imagination is not None
    assert (policy.imagination.refresh_every, policy.imagination.penalty_up_on) == (0, "mixture")


def test_written_numbers_mean_the_same_to_yaml_1_1_readers() -> None:
    assert not re.search(r": [\d.]+e", params_yaml(preset_params("paper")))


def test_every_option_is_explained() -> None:
    for cls in options_classes():
        assert meanings(cls).keys() == get_type_hints(cls).keys()
        assert all(meanings(cls).values())


def test_every_number_has_a_range() -> None:
    assert [key for key in numeric_fields() if key[1] not in RANGES] == []


def test_absent_options_take_their_defaults(tmp_path: Path) -> None:
    params = load(tmp_path, "seed: 3\ntrain_policy: {et_cql: {imagination: {horizon: 2}}}")
    assert params.seed == 3
    assert params.train_policy.et_cql.imagination == dataclasses.replace(
        Params().train_policy.et_cql.imagination,  # pyright: ignore[reportArgumentType]
        horizon=2,
    )
    assert load(tmp_path, "") == Params()


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    params = load(tmp_path, "seed: 3\nthreads: 4", "seed=7", "train_policy.cql.hidden=[8, 8]")
    assert (params.seed, params.threads, params.train_policy.cql.hidden) == (7, 4, (8, 8))


@pytest.mark.parametrize("text", ["3e-4", "3.0e-04", "0.0003", "0.000_3"])
def test_every_spelling_of_a_number_is_a_number(text: str, tmp_path: Path) -> None:
    assert load(tmp_path, f"train_model: {{learning_rate: {text}}}").train_model.learning_rate == pytest.approx(3e-4)


def test_a_whole_float_is_a_fine_count(tmp_path: Path) -> None:
    updates = load(tmp_path, "train_model: {updates: 1e4}").train_model.updates
    assert updates == 10_000
    assert isinstance(updates, int)


@settings(deadline=None)  # the first example pays for imports
@given(st.integers(1, 10**9), st.floats(1e-12, 1e3), st.lists(st.integers(1, 4096), min_size=1, max_size=5))
def test_what_is_written_is_what_was_meant(seed: int, rate: float, hidden: list[int]) -> None:
    tree = {"seed": seed, "train_model": {"learning_rate": rate}, "train_policy": {"cql": {"hidden": hidden}}}
    params = build_params(tree)
    assert build_params(YAML(typ="safe", pure=True).load(params_yaml(params))) == params


REFUSED = {
    "sed: 1": ["sed", "did you mean 'seed'?"],
    "seed: one": ["seed is 'one'", "an integer"],
    "seed: true": ["seed is True", "an integer"],
    "seed: -1": ["seed is -1", "0 or more"],
    "threads: 1.5": ["threads is 1.5", "an integer"],
    "threads: null": ["threads is null", "an integer"],
    "task: hoper-medium": ["'hoper-medium'", "did you mean 'hopper-medium'?"],
    "precision: fp16": ["precision is 'fp16'", "did you mean 'bf16'?"],
    "train_model: 3": ["train_model is 3", "a section with the keys model"],
    "train_model: {model: {widht: 3}}": ["'widht' in train_model.model", "did you mean 'width'?"],
    "train_model: {learning_rate: .nan}": ["train_model.learning_rate is nan", "more than 0"],
    "train_model: {held_out: 1}": ["train_model.held_out is 1", "in (0, 1)"],
    "train_model: {model: {heads: 3}}": ["width is 128", "heads is 3", "a multiple of 6"],
    "train_model: {updates: 10, updates_per_epoch: 3}": ["updates is 10", "updates_per_epoch (3)"],
    "train_policy: {cql: {hidden: []}}": ["train_policy.cql.hidden is []", "a list"],
    "train_policy: {cql: {hidden: [8, 0]}}": ["train_policy.cql.hidden is 0", "1 or more"],
    "train_policy: {cql: {layer_norm: 1}}": ["layer_norm is 1", "true or false"],
    "train_policy: {cql: {warm_start: 20000}}": ["warm_start is 20000", "a part of them"],
    "train_policy: {cql: {imagination: {horizon: 1}}}": ["cql.imagination must be null"],
    "train_policy: {et_cql: {imagination: null}}": ["et_cql.imagination is null"],
    "train_policy: {et_cql: {imagination: {horizn: 1}}}": ["'horizn'", "did you mean 'horizon'?"],
    "train_model: {model: {epistemic: none}}": ["novelty_limit is 1.0", "epistemic is none", "to laplace", "to null"],
    "train_model: {ensemble: {members: 1, elites: 1}}": ["novelty_limit is 1.0", "members is 1", "to 2", "to null"],
    "train_model: {ensemble: {elites: 1}}": ["imagination.posterior is 1.0", "elites is 1", "to 2 or more", "to 0"],
    "generate_rollouts: {history: 40}": ["generate_rollouts.history is 40", "at most 15"],
    "download: {source: file}": ["download.path is null", "give the path"],
    "download: {source: minari}": ["download.minari_id is null", "mujoco/hopper/medium-v0"],
    "download: {source: file, path: x.h5, minari_id: a-v0}": ["download.minari_id is 'a-v0'", "to 'minari'"],
    "download: {source: minari, path: x.h5, minari_id: a-v0}": ["download.path is 'x.h5'", "to null"],
    "download: {path: x.h5}": ["download.path is 'x.h5'", "set download.source to 'file'"],
    "download: {transitions: 10}": ["download.transitions is 10", "1000 or more"],
    "evaluate: {video_frames: 151}": ["evaluate.video_frames is 151", "from 2 to 150"],
    "seed: [": ["not valid YAML"],
    "seed: 1\nseed: 2": ["not valid YAML", "seed"],
    "- 1": ["expected a section"],
}


@pytest.mark.parametrize("text", REFUSED)
def test_bad_input_is_refused_in_one_sentence(text: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as refusal:
        load(tmp_path, text)
    sentence = str(refusal.value)
    assert "\n" not in sentence
    assert [part for part in REFUSED[text] if part not in sentence] == [], sentence


def test_what_an_ensemble_does_not_read_may_be_anything(tmp_path: Path) -> None:
    unread = "updates: 5, model: {epistemic: none, width: 5, context: 1}"
    assert load(tmp_path, f"train_model: {{{unread}, ensemble: {{}}}}").train_model.model.epistemic == "none"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.yaml does not exist"):
        load_params(tmp_path / "nowhere.yaml")


def test_an_override_needs_a_value(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="write key=value"):
        load(tmp_path, "", "seed")


def test_an_unknown_preset_gets_a_suggestion() -> None:
    with pytest.raises(UserError, match="did you mean 'tiny'"):
        preset_params("tinny")


def test_describe_lists_every_option_of_a_section() -> None:
    described = {option.key: option.default for option in describe("train_policy.et_cql")}
    assert described == leaves(dump_params(Params())["train_policy"]["et_cql"], "train_policy.et_cql")
