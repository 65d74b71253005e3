"""Every kind of bad content as one readable clause with its fix, and what reading changes as a note."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from logs import Columns
from logs import columns as file_columns

from envtf_lit.data.checks import build_dataset, examine
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding
from envtf_lit.errors import UserError

ATTRIBUTES = ("task", "action_low", "action_high", "held_out")


def columns(*dims: int) -> Columns:
    """By our names rather than D4RL's."""
    content = file_columns(*dims)
    return content | {"terminated": content.pop("terminals"), "truncated": content.pop("timeouts")}


def limits(low: Any, high: Any) -> Callable[[Columns], None]:
    return lambda content: content.update(action_low=low, action_high=high)


def find(content: Columns, task: str | None = None) -> tuple[OfflineDataset | None, list[Finding]]:
    plain = {name: np.asarray(values) for name, values in content.items() if name not in ATTRIBUTES}
    return examine(plain, {name: content[name] for name in ATTRIBUTES if name in content}, task=task)


def errors(content: Columns, task: str | None = None) -> list[str]:
    dataset, findings = find(content, task)
    found = [str(finding) for finding in findings if finding.kind == "error"]
    assert (dataset is None) == bool(found)
    return found


def notes(content: Columns) -> str:
    dataset, findings = find(content)
    assert dataset is not None
    return "; ".join(str(finding) for finding in findings)


def put(name: str, value: Any) -> Callable[[Columns], None]:
    return lambda content: content.update({name: value})


def change(name: str, function: Callable[[np.ndarray], Any]) -> Callable[[Columns], None]:
    return lambda content: content.update({name: function(content[name])})


def at(name: str, index: Any, value: float) -> Callable[[Columns], None]:
    return lambda content: content[name].__setitem__(index, value)


def drop(name: str) -> Callable[[Columns], None]:
    return lambda content: content.pop(name)


def indexed(*index: float) -> Callable[[Columns], None]:
    return lambda content: content.update(episode_index=np.array(index))


BAD = {
    "no observations": (drop("observations"), "there are no 'observations': a dataset needs"),
    "no actions": (drop("actions"), "there are no 'actions'"),
    "no rewards": (drop("rewards"), "there are no 'rewards'"),
    "no terminals": (drop("terminated"), "there is no 'terminated' (or 'terminals')"),
    "no timeouts": (drop("truncated"), "there is no 'truncated' (or 'timeouts'): store both flags"),
    "short": (change("actions", lambda x: x[:-1]), "'actions' has 11 rows and 'observations' has 12"),
    "rank 1": (change("observations", lambda x: x[:, 0]), "'observations' has shape (12,): reshape it to"),
    "choices": (put("actions", np.arange(12) % 3), "'actions' has shape (12,): if they number choices, take another"),
    "rank 2": (change("rewards", lambda x: x[:, None]), "'rewards' has shape (12, 1)"),
    "scalar": (put("rewards", 1.0), "'rewards' has shape ()"),
    "narrow": (change("next_observations", lambda x: x[:, :3]), "(12, 3) and 'observations' (12, 11): make them equal"),
    "no dimensions": (change("actions", lambda x: x[:, :0]), "which is empty"),
    "nan": (at("observations", (5, 2), np.nan), "'observations' has NaN or infinite values, first at row 5 (1 rows in"),
    "infinite": (at("rewards", slice(3, 5), np.inf), "'rewards' has NaN or infinite values, first at row 3 (2 rows in"),
    "huge": (put("rewards", np.full(12, 1e300)), "'rewards' reaches 1e+300 at row 0 (12 rows"),
    "flag": (change("terminated", lambda x: x + 2), "'terminated' is 2 at row 0 (12 rows in all): flags must be 0"),
    "nan flag": (put("truncated", np.full(12, np.nan)), "'truncated' is nan at row 0"),
    "text": (put("rewards", np.array(["a"] * 12)), "'rewards' holds <U1 values: store plain numbers"),
    "action": (at("actions", (4, 1), 1.5), "[-1, 1] in 8.3% of the rows, first at row 4: clip them (np.clip), if"),
    "zero rows": (change("rewards", lambda x: x[:0]), "which is empty"),
    "action limits": (limits(np.full(3, 2.0), np.ones(3)), "is not below"),
    "infinite limits": (limits(np.full(3, -1e300), np.ones(3)), "is not below"),
    "action limit shape": (limits(np.full(2, -1.0), np.ones(3)), "must be 3 finite numbers"),
    "action limit type": (limits(-np.ones(3), "high"), "must be 3 finite numbers"),
    "half the limits": (put("action_high", 1.0), "there is 'action_high' and no 'action_low': store both"),
    "small actions": (
        change("actions", lambda x: 0.4 * x),
        "reach from -0.4 to 0.4 in dimension 0, which does not",
    ),
    "one small action": (change("actions", lambda x: x * np.array([1, 1, 0.5])), "-0.5 to 0.5 in dimension 2, which"),
    "actions of one sign": (change("actions", np.abs), "does not fill the usual [-1, 1]: state the robot's own"),
    "split by rows": (put("held_out", np.ones(12)), "'held_out' has shape (12,), and there are 3 episodes: store for"),
    "nothing held out": (put("held_out", np.zeros(3)), "'held_out' has shape (3,), and there are 3 episodes"),
    "odd split": (put("held_out", np.array([0, 1, 2])), "store for each episode 1 if it is held out"),
    "flag inside": (
        indexed(*[0] * 7, *[1] * 5),
        "an episode ends at row 3 by its flags and goes on by 'episode_index'",
    ),
    "index returns": (indexed(*[0] * 4, *[1] * 3, *[0] * 5), "'episode_index' comes back to 0 at row 7"),
    "half an index": (indexed(*[0.5] * 12), "'episode_index' is 0.5 at row 0: number the episodes with whole numbers"),
    "nan index": (indexed(*[np.nan] * 12), "'episode_index' is nan at row 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_content_is_named_with_its_fix(case: str):
    spoil, message = BAD[case]
    content = columns()
    spoil(content)
    found = errors(content)
    assert any(message in text for text in found), found
    assert not any("\n" in text for text in found)


@pytest.mark.parametrize(
    "case", ["short", "rank 1", "choices", "rank 2", "scalar", "narrow", "no dimensions", "zero rows"]
)
def test_one_misshapen_column_is_one_error(case: str):
    content = columns()
    BAD[case][0](content)
    assert len(errors(content)) == 1


def test_the_odd_length_is_that_of_the_fewest_columns():
    content = columns()
    for name in ("rewards", "actions"):
        content[name] = content[name][:-1]
    assert [text.split(" has")[0] for text in errors(content)] == ["'actions'", "'rewards'"]


def test_all_errors_come_at_once_and_the_first_is_the_sentence_of_loading():
    content = columns()
    for case in ("no timeouts", "short", "nan", "action limit shape"):
        BAD[case][0](content)
    assert len(errors(content)) == 4
    low, high = content.pop("action_low"), content.pop("action_high")
    with pytest.raises(UserError, match=r"^my.h5: there is no 'truncated'[^\n]*\.$"):
        build_dataset(content, {"action_low": low, "action_high": high}, task=None, source="my.h5")


@pytest.mark.parametrize(
    ("task", "dims", "message"),
    [
        ("ant-medium", (11, 3), "11 observation and 3 action dimensions, and Ant-v5 has 27 and 8"),
        ("walker2d-medium", (17, 6), "was made for halfcheetah-random, not for walker2d-medium"),
    ],
)
def test_task_that_does_not_fit(task: str, dims: tuple[int, int], message: str):
    content = columns(*dims) | ({"task": "halfcheetah-random"} if dims[0] == 17 else {})
    assert message in errors(content, task)[0]


def test_unknown_task():
    with pytest.raises(UserError, match="did you mean 'hopper-medium'"):
        find(columns(), "hopper-mediun")


@pytest.mark.parametrize("task", ["hopper-medium-v2", 3.0])
def test_a_task_of_others_is_no_task_of_ours(task: Any):
    dataset, _ = find(columns() | {"task": task})
    assert dataset is not None
    assert dataset.task is None


# episode ends


def test_an_index_alone_makes_truncated_episodes():
    content = columns()
    del content["terminated"], content["truncated"]
    indexed(*[7] * 4, *[3] * 3, *[9] * 5)(content)
    dataset, _ = find(content)
    assert dataset is not None
    assert dataset.episode_starts.tolist() == [0, 4, 7]
    assert not dataset.terminated.any()
    assert np.flatnonzero(dataset.truncated).tolist() == [3, 6, 11]


def test_an_index_with_terminations_keeps_them():
    content = columns()
    del content["truncated"]
    indexed(*[0] * 4, *[1] * 3, *[2] * 5)(content)
    dataset, _ = find(content)
    assert dataset is not None
    assert np.flatnonzero(dataset.terminated).tolist() == [3]
    assert np.flatnonzero(dataset.truncated).tolist() == [6, 11]


def test_an_episode_may_be_a_single_step():
    content = columns()
    content["truncated"][[4, 10]] = True
    dataset, _ = find(content)
    assert dataset is not None
    assert dataset.episode_lengths.tolist() == [4, 1, 2, 4, 1]


def test_without_next_observations_a_single_row_is_no_transition():
    content = columns()
    del content["next_observations"]
    content["truncated"][[4, 10]] = True
    dataset, _ = find(content)
    assert dataset is not None
    assert dataset.rewards.tolist() == content["rewards"][[0, 1, 2, 5, 7, 8, 9]].tolist()
    assert dataset.episode_starts.tolist() == [0, 3, 4]
    for name in ("terminated", "truncated"):
        content[name][:] = name == "truncated"
    assert "every episode is a single row" in errors(content)[0]


# what reading changes


def test_notes():
    content = columns()
    assert notes(content) == "the log stops inside an episode, whose last row counts as truncated"
    content["truncated"][[3, 11]] = True
    content["rewards"] = content["rewards"].astype(np.float64)
    said = notes(content)
    assert "'rewards' is float64 and becomes float32" in said
    assert "1 rows are both terminated and truncated" in said
    del content["next_observations"]
    assert "the last row of each of 3 episodes is left out, and with it 1 terminations" in notes(content)


def test_the_arrays_given_stay_as_they_are():
    content = columns()
    content["actions"][2, 1] = 1.000005
    before = {name: values.copy() for name, values in content.items()}
    dataset, _ = find(content)
    assert dataset is not None
    assert np.max(dataset.actions) == 1
    assert all(np.array_equal(content[name], before[name]) for name in before)


def warnings(content: Columns) -> list[str]:
    return [str(finding) for finding in find(content)[1] if finding.kind == "warning"]


def test_actions_need_not_fill_the_limits_that_are_stated_or_the_robots():
    content = columns()
    content["actions"] *= np.float32(0.3)
    assert not errors(content | {"action_low": -1.0, "action_high": 1.0})
    assert not errors(content, task="hopper-medium")
    dataset, _ = find(content | {"action_low": -0.4, "action_high": np.array([0.4])})
    assert dataset is not None and dataset.action_high.tolist() == [np.float32(0.4)] * 3


def test_rounding_beyond_the_limits_is_beside_the_limits_own_size():
    content, unit = columns(), 1e-9
    content["actions"] *= np.float32(unit)
    limit = {"action_low": -unit, "action_high": unit}
    content["actions"][3, 0] = unit * 1.000005
    dataset, _ = find(content | limit)
    assert dataset is not None and np.max(np.asarray(dataset.actions)) == np.float32(unit)
    content["actions"][3, 0] = unit * 1.01
    assert "outside the action space" in errors(content | limit)[0]


def test_numbered_choices_are_told_from_quantities():
    content = columns(11, 1)
    content["actions"] = np.arange(12)[:, None] % 3 - 1
    (found,) = warnings(content)
    assert found.startswith("all actions are whole numbers (-1, 0, 1): if they number choices, take another method")
    content["actions"] = content["actions"] * 0.99
    assert not warnings(content)


@pytest.mark.parametrize(("offset", "lost"), [(0.0, False), (1e3, False), (3e7, True), (1.7e9, True)])
def test_detail_that_float32_loses_is_told(offset: float, lost: bool):
    content = columns(3)
    for name in ("observations", "next_observations"):
        content[name] = content[name].astype(np.float64)
        content[name][:, 1] += offset
        content[name][:, 2] = 0.1 + 0.2 + np.arange(12) % 2 * 1e-16  # rounding, not detail
    content["rewards"] = content["rewards"].astype(np.float64) + offset
    found = warnings(content)
    assert len(found) == 3 * lost
    beginnings = ("'observations' varies in dimension 1 by ", "'rewards' varies by ", "'next_observations' varies in ")
    for text, beginning in zip(found, beginnings if lost else (), strict=True):
        assert text.startswith(beginning) and "float32 keeps next to nothing: subtract an offset" in text


def test_the_split_of_a_file_survives_the_loss_of_its_last_rows():
    content = columns() | {"held_out": np.array([0, 1, 1]), "episode_index": np.repeat([0, 1, 2], [4, 1, 7])}
    del content["next_observations"], content["terminated"], content["truncated"]
    dataset, _ = find(content)
    assert dataset is not None and dataset.held_out is not None
    assert dataset.held_out.tolist() == [False, True]


@pytest.mark.parametrize("task", ["halfcheetah-medium", "walker2d-medium"])
def test_falls_of_another_robot_are_not_taken_for_the_tasks(task: str) -> None:
    """Walker2d and HalfCheetah have the same dimensions, and not the same rule."""
    rng = np.random.default_rng(0)
    heights = rng.uniform(0.5, 1.5, 200).astype(np.float32)  # a walker2d falls below 0.8
    states = np.zeros((200, 17), np.float32)
    states[:, 0] = heights
    log = dict(
        observations=states,
        actions=rng.uniform(-1, 1, (200, 6)).astype(np.float32),
        rewards=np.ones(200, np.float32),
        next_observations=states,
        terminated=heights <= np.float32(0.8),
        truncated=np.zeros(200, bool),
    )
    for right in (True, False):
        made = log if right == (task == "walker2d-medium") else log | {"terminated": np.zeros(200, bool)}
        dataset, findings = examine(made, {}, task=task)
        assert dataset is not None
        assert right == (not [f for f in findings if f.kind == "warning" and "falls by one of them alone" in f.what])
