"""What params.yaml must not say, and with which words it is refused; files of earlier versions among it."""

import dataclasses
import re
from pathlib import Path

import pytest

from envtf_lit.errors import UserError
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.renamed_options import FORMER
from envtf_lit.pipeline.yaml import dump_params, load_params, preset_params
from envtf_lit.world_models.options import TransformerOptions
from tests.test_config import ROOT, leaves, load


def refusal(tmp_path: Path, text: str, *overrides: str) -> str:
    with pytest.raises(UserError) as refused:
        load(tmp_path, text, *overrides)
    assert "\n" not in str(refused.value)
    return str(refused.value)


BC = "bc: {algorithm: bc}"
REFUSED = {
    "sed: 1": ["sed", "did you mean 'seed'?"],
    "seed: one": ["seed is 'one'", "an integer"],
    "seed: true": ["seed is True", "an integer"],
    "seed: -1": ["seed is -1", "0 or more"],
    "threads: 1.5": ["threads is 1.5", "an integer"],
    "threads: null": ["threads is null", "an integer"],
    f"seed: 1{'0' * 400}": ["seed is 1000", "an integer"],
    "task: hoper-medium": ["'hoper-medium'", "did you mean 'hopper-medium'?"],
    "task: null": ["task is null", "download.source is 'zoo'", "to 'file'"],
    "precision: fp16": ["precision is 'fp16'", "did you mean 'bf16'?"],
    "policy: 3": ["policy is 3", "a section with the keys updates"],
    "policy: {discont: 0.9}": ["'discont' in policy", "did you mean 'discount'?"],
    "policy: {critic_learning_rate: .nan}": ["policy.critic_learning_rate is nan", "more than 0"],
    "policy: {updates: 10, updates_per_epoch: 3}": ["policy.updates is 10", "updates_per_epoch (3)"],
    "policy: {updates: 15, updates_per_epoch: 5}": ["policy.updates_per_epoch is 5", "a multiple of 10"],
    "policy: {hidden: []}": ["policy.hidden is []", "a list"],
    "policy: {hidden: [8, 0]}": ["policy.hidden is 0", "more than 0"],
    "policy: {layer_norm: 1}": ["policy.layer_norm is 1", "true or false"],
    "policy: {warm_start: -1}": ["policy.warm_start is -1", "0 or more"],
    "policy: {target_rate: 0}": ["policy.target_rate is 0", "in (0, 1]"],
    "policy: {cql_weight: 1}": ["'cql_weight' in policy"],
    "train_model: 3": ["train_model is 3", "one section or more"],
    "train_model: {}": ["train_model is {}", "one section or more"],
    "train_model: {a: 3}": ["train_model.a is 3", "a section with the key kind"],
    "train_model: {a: {width: 8}}": ["train_model.a has no kind", "`kind: transformer`", "ensemble"],
    "train_model: {a: {kind: transfomer}}": ["train_model.a.kind is 'transfomer'", "did you mean 'transformer'?"],
    "train_model: {a: {kind: transformer, widht: 3}}": ["'widht' in train_model.a", "did you mean 'width'?"],
    "train_model: {a: {kind: transformer, members: 3}}": ["'members' in train_model.a"],
    "train_model: {a: {kind: transformer, heads: 3}}": ["train_model.a.width is 128", "heads is 3", "multiple of 6"],
    "train_model: {a: {kind: transformer, updates: 10, updates_per_epoch: 3}}": ["train_model.a.updates is 10", "(3)"],
    "train_model: {a: {kind: transformer, objective: paper_mse}}": ["objective is paper_mse", "set epistemic to head"],
    "train_model: {a: {kind: ensemble, elites: 8}}": ["train_model.a.elites is 8", "members is 7"],
    "train_model: {a: {kind: ensemble, hidden: [8]}}": ["weight_decay has 5 entries", "there are 2 layers"],
    "train_model: {none: {kind: ensemble}}": ["train_model has a section 'none'", "not 'none'"],
    "train_model: {a/b: {kind: ensemble}}": ["train_model has a section 'a/b'", "letters, digits, _ and -"],
    "train_model: {..: {kind: ensemble}}": ["train_model has a section '..'"],
    "train_policy: {'': {algorithm: bc}}": ["train_policy has a section ''", "letters, digits, _ and -"],
    "train_policy: {none: {algorithm: bc}}": ["train_policy has a section 'none'"],
    "train_policy: null": ["train_policy is None", "one section or more"],
    "train_policy: {cql: null}": ["train_policy.cql is null", "a section with the key algorithm"],
    "train_policy: {cql: {cql_weight: 1}}": ["train_policy.cql has no algorithm", "`algorithm: bc`", "et_cql_paper"],
    "train_policy: {cql: {algorithm: clq}}": ["train_policy.cql.algorithm is 'clq'", "did you mean 'cql'?"],
    f"train_policy: {{{BC}, cql: {{algorithm: cql, hidden: [8, 0]}}}}": ["train_policy.cql.hidden is 0", "more than 0"],
    f"train_policy: {{{BC}, cql: {{algorithm: cql, rollouts: {{}}}}}}": ["'rollouts' in train_policy.cql"],
    f"train_policy: {{{BC}, cql: {{algorithm: cql, world_model: transformer}}}}": [
        "cql learns from data alone",
        "none",
    ],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, world_model: none}}}}": ["et_cql imagines", "such as transformer"],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, world_model: trans}}}}": ["is 'trans'", "'transformer'?"],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, rollouts: null}}}}": ["train_policy.x.rollouts is null"],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, rollouts: {{horizn: 1}}}}}}": ["'horizn'", "mean 'horizon'?"],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, updates: 500}}}}": ["value_gradient.updates is 400", "500 updates"],
    f"train_policy: {{{BC}, x: {{algorithm: et_cql, value_gradient: {{horizon: 3}}}}}}": [
        "horizon is 3",
        "history is 4",
    ],
    f"train_policy: {{{BC}, x: {{algorithm: combo, world_model: transformer, rollouts: {{history: 16}}}}}}": [
        "history is 16",
        "at most 15",
    ],
    "train_policy: {cql: {algorithm: cql}}": ["'bc' below train_policy"],
    "generate_rollouts: {policy: et_cql}": ["generate_rollouts.policy is et_cql", "such as bc"],
    "generate_rollouts: {policy: bcc}": ["'bcc' below train_policy", "did you mean"],
    "generate_rollouts: {history: 40}": ["generate_rollouts.history is 40", "at most 15"],
    "evaluate: {world_model: ensemble}": ["'ensemble' below train_model", "transformer"],
    "evaluate: {video_frames: 151}": ["evaluate.video_frames is 151", "in [2, 150]"],
    "download: {held_out: 1}": ["download.held_out is 1", "in (0, 1)"],
    "download: {source: file}": ["download.path is null", "give the path"],
    "download: {source: minari}": ["download.minari_id is null", "mujoco/hopper/medium-v0"],
    "download: {source: file, path: 3}": ["download.path is 3", "a text"],
    "download: {source: file, path: x.h5, minari_id: a-v0}": ["download.minari_id is 'a-v0'", "to 'minari'"],
    "download: {source: minari, path: x.h5, minari_id: a-v0}": ["download.path is 'x.h5'", "to null"],
    "download: {path: x.h5}": ["download.path is 'x.h5'", "set download.source to 'file'"],
    "download: {transitions: 10}": ["download.transitions is 10", "1000 or more"],
    "seed: [": ["not valid YAML"],
    "seed: 1\nseed: 2": ["not valid YAML", "seed"],
    "- 1": ["the file holds [1]", "expected a section"],
    "hello": ["the file holds 'hello'", "expected a section"],
}


@pytest.mark.parametrize("text", REFUSED)
def test_bad_input_is_refused_in_one_sentence(text: str, tmp_path: Path) -> None:
    sentence = refusal(tmp_path, text)
    assert sentence.startswith(f"{tmp_path / 'params.yaml'}")
    assert [part for part in REFUSED[text] if part not in sentence] == [], sentence


EPISTEMIC = {
    ("epistemic: none", 1.0): ["novelty_limit is 1.0", "a.epistemic is none", "to laplace", "to null"],
    ("epistemic: none", None): ["rollouts.posterior is 1.0", "a.epistemic is none", "to laplace", "to 0"],
    ("kind: ensemble, members: 1, elites: 1", 1.0): ["novelty_limit is 1.0", "members is 1", "to 2", "to null"],
    ("kind: ensemble, elites: 1", 1.0): ["rollouts.posterior is 1.0", "elites is 1", "to 2 or more", "to 0"],
}


@pytest.mark.parametrize(("model", "limit"), EPISTEMIC)
def test_what_rollouts_ask_of_a_model_it_must_have(model: str, limit: float | None, tmp_path: Path) -> None:
    model = model if "kind" in model else f"kind: transformer, {model}"
    shown = "null" if limit is None else limit
    rollouts = f"{{novelty_limit: {shown}}}"
    text = (
        f"train_model: {{a: {{{model}}}}}\ngenerate_rollouts: {rollouts}\nevaluate: {{world_model: a}}\n"
        f"train_policy: {{{BC}, x: {{algorithm: et_cql, world_model: a, rollouts: {rollouts}}}}}"
    )
    sentence = refusal(tmp_path, text)
    assert [part for part in EPISTEMIC[model.removeprefix("kind: transformer, "), limit] if part not in sentence] == []


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.yaml does not exist: run `envtf init"):
        load_params(tmp_path / "nowhere.yaml")


def test_a_file_that_cannot_be_read_is_said_to_be_so(tmp_path: Path) -> None:
    (tmp_path / "latin.yaml").write_bytes(b"task: \xe9")
    with pytest.raises(UserError, match=r"Cannot read .*latin\.yaml .*: give a YAML file\."):
        load_params(tmp_path / "latin.yaml")
    with pytest.raises(UserError, match=r"is not a file, but a folder, a pipe or a device: give a file\."):
        load_params(tmp_path)


@pytest.mark.parametrize("override", ["seed", "=1", ""])
def test_an_override_needs_a_key_and_a_value(override: str, tmp_path: Path) -> None:
    (example,) = re.findall(r"write key=value, such as (\S+)\.$", refusal(tmp_path, "", override))
    assert load(tmp_path, "", example) != Params()


def test_an_override_is_yaml(tmp_path: Path) -> None:
    assert refusal(tmp_path, "", "seed=[").startswith("The value of seed is not valid YAML")


def test_an_unknown_preset_gets_a_suggestion() -> None:
    with pytest.raises(UserError, match="did you mean 'tiny'"):
        preset_params("tinny")


# files of earlier versions

YESTERDAY = {
    "train_model: {model: {layers: 4}, ensemble: null, updates: 6000}": [
        "train_model.model",
        "train_model.transformer",
    ],
    "train_model: {ensemble: {members: 3}}": ["train_model.ensemble", "`kind: ensemble`"],
    "train_model: {updates: 9000}": ["train_model.updates", "train_model.transformer.updates"],
    "train_model: {held_out: 0.2}": ["train_model.held_out", "download.held_out"],
    "generate_rollouts: {clone_updates: 2000}": ["generate_rollouts.clone_updates", "train_policy.bc.updates"],
    "generate_rollouts: {mode: mean}": ["generate_rollouts.mode", "it is gone"],
    "train_policy: {et_cql: {imagination: {horizon: 2}}}": ["train_policy.et_cql.imagination", "rollouts"],
    "train_policy: {et_cql: {algorithm: et_cql, critics: 3}}": ["train_policy.et_cql.critics", "it is gone"],
}


@pytest.mark.parametrize("text", YESTERDAY)
def test_a_file_of_an_earlier_version_is_led_on(text: str, tmp_path: Path) -> None:
    sentence = refusal(tmp_path, text)
    expected = [*YESTERDAY[text], "an earlier version", "`envtf params`", "`envtf init`", "CHANGELOG.md"]
    assert [part for part in expected if part not in sentence] == [], sentence


def test_an_override_of_an_earlier_version_is_led_on(tmp_path: Path) -> None:
    assert "it is train_model.transformer.updates now" in refusal(tmp_path, "", "train_model.updates=9000")
    assert "train_policy.et_cql.imagination is" in refusal(tmp_path, "", "train_policy.et_cql.imagination.horizon=2")


def test_where_options_went_is_where_options_are(tmp_path: Path) -> None:
    """And the CHANGELOG tells of each."""
    places = {key: now for key, now in FORMER.items() if re.fullmatch(r"[\w.]+", now)}
    tree = leaves(dump_params(Params())) | leaves(dump_params(Params())["policy"], "train_policy.bc")
    assert len(places) > 10
    assert [now for now in places.values() if not any(f"{key}.".startswith(f"{now}.") for key in tree)] == []
    changes = (ROOT / "CHANGELOG.md").read_text()
    told = {key for key in FORMER if f"`{key.replace('*', 'NAME')}" in changes}
    by_rule = {f"train_model.{field.name}" for field in dataclasses.fields(TransformerOptions)}
    assert set(FORMER) - by_rule <= told


def test_a_model_may_have_an_old_options_name(tmp_path: Path) -> None:
    text = "train_model: {ensemble: {kind: ensemble}, model: {kind: transformer}}\nevaluate: {world_model: model}\n"
    text += f"train_policy: {{{BC}}}"
    assert [*load(tmp_path, text).train_model] == ["ensemble", "model"]
