"""Parquet in and out, and CSV in: names of robots' logs, nothing lost, nothing believed."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from envtf_lit.data.check_report import inspect_source
from envtf_lit.data.columns import Column
from envtf_lit.data.conversion import convert
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.errors import UserError
from tests.logs import assert_equal, columns, dataset_of_chains, write


def lists(values: Column) -> list[list[float]]:
    return np.asarray(values).tolist()


def lerobot(data: OfflineDataset) -> dict[str, Any]:
    """The frames of whole episodes, as LeRobot's recorder has them: no next observations, one flag."""
    episode = np.repeat(np.arange(len(data.episode_starts)), data.episode_lengths)
    return {
        "observation.state": lists(data.observations),
        "action": lists(data.actions),
        "episode_index": episode,
        "frame_index": np.arange(len(data)) - data.episode_starts[episode],
        "timestamp": np.arange(len(data)) / 50.0,
        "next.reward": data.rewards,
        "next.done": data.terminated | data.truncated,
    }


def table(path: Path, content: dict[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(content), path)
    return path


@pytest.mark.parametrize("task", [None, "hopper-medium-replay"])
def test_there_and_back_nothing_is_lost(tmp_path: Path, task: str | None) -> None:
    content = columns() | {"action_low": np.full(3, -1.1), "action_high": np.full(3, 3.3)}
    data = load_dataset(write(tmp_path / "in.h5", content), task=task).with_split(0.3, seed=0)
    save_dataset(data, tmp_path / "first.h5")
    convert(str(tmp_path / "first.h5"), str(tmp_path / "middle.parquet"))
    _, findings = convert(str(tmp_path / "middle.parquet"), str(tmp_path / "last.h5"))
    assert (tmp_path / "last.h5").read_bytes() == (tmp_path / "first.h5").read_bytes()
    assert [str(finding) for finding in findings] == ["left behind, for a dataset has no such columns: frame_index"]
    assert_equal(load_dataset(tmp_path / "last.h5"), data)


def test_what_is_written_is_a_table_that_others_read(tmp_path: Path) -> None:
    data = load_dataset(write(tmp_path / "in.npz", columns()))
    convert(str(tmp_path / "in.npz"), str(tmp_path / "out.parquet"))
    found = pq.read_table(tmp_path / "out.parquet").to_pydict()
    assert np.array_equal(np.asarray(found["observation.state"], np.float32), data.observations)
    assert found["episode_index"] == [0] * 4 + [1] * 3 + [2] * 5
    assert found["frame_index"] == [*range(4), *range(3), *range(5)]
    assert [row for row, done in enumerate(found["next.done"]) if done] == [3, 6, 11]
    assert [row for row, end in enumerate(found["next.terminated"]) if end] == [3]


def test_a_lerobot_log_is_understood(tmp_path: Path) -> None:
    data = dataset_of_chains()
    path = table(tmp_path / "log.parquet", lerobot(data))
    found, findings = convert(str(path), str(tmp_path / "out.h5"), action_low=[-1], action_high=[1])
    assert np.array_equal(found.observations, data.observations[[0, 1, 3, 5, 6, 7]])
    assert np.array_equal(found.next_observations, data.observations[[1, 2, 4, 6, 7, 8]])
    assert found.episode_starts.tolist() == [0, 2, 3]
    assert not found.terminated.any()
    said = " ".join(str(finding) for finding in findings)
    assert "'next.done' says that an episode ended and not why" in said
    assert "left behind, for a dataset has no such columns: frame_index, timestamp" in said


def test_a_lerobot_folder_is_one_log(tmp_path: Path) -> None:
    data = dataset_of_chains()
    whole, ends = lerobot(data), [0, 3, 5, 9]
    for number in range(3):
        part = {name: values[ends[number] : ends[number + 1]] for name, values in whole.items()}
        table(tmp_path / f"log/data/chunk-000/episode_00000{number}.parquet", part)
    (tmp_path / "log/meta").mkdir()
    (tmp_path / "log/meta/info.json").write_text("{}")
    limits: dict[str, Any] = {"action_low": [-1], "action_high": [1]}
    folder, _ = convert(str(tmp_path / "log"), str(tmp_path / "folder.h5"), **limits)
    file, _ = convert(str(table(tmp_path / "one.parquet", whole)), str(tmp_path / "file.h5"), **limits)
    assert_equal(folder, file)


def test_next_terminated_says_why_an_episode_ended(tmp_path: Path) -> None:
    data = dataset_of_chains()
    content = lerobot(data) | {"next.terminated": data.terminated, "next.truncated": data.truncated}
    content["next.observation.state"] = lists(data.next_observations)
    convert(str(table(tmp_path / "a.pq", content)), str(tmp_path / "b.npz"), action_low=[-1], action_high=[1])
    assert_equal(load_dataset(tmp_path / "b.npz"), data)


@pytest.mark.parametrize("kind", ["large_list", "float64", "apart"])
def test_other_layouts_of_the_same_numbers(tmp_path: Path, kind: str) -> None:
    data = dataset_of_chains()
    content = lerobot(data)
    if kind == "apart":
        del content["action"]
        content |= {"action_1": data.actions[:, 1], "action_0": data.actions[:, 0]}
    else:
        inner = pa.large_list(pa.float32()) if kind == "large_list" else pa.list_(pa.float64())
        content["action"] = pa.array(lists(data.actions), inner)
    plain = convert(
        str(table(tmp_path / "a.parquet", lerobot(data))), str(tmp_path / "a.h5"), action_low=[-1], action_high=[1]
    )
    other = convert(
        str(table(tmp_path / "b.parquet", content)), str(tmp_path / "b.h5"), action_low=[-1], action_high=[1]
    )
    assert_equal(other[0], plain[0])


# CSV


def sheet(path: Path, content: dict[str, Any]) -> Path:
    flat: dict[str, Any] = {}
    for name, values in content.items():
        values = np.asarray(values)
        flat |= {f"{name}.{i}": values[:, i] for i in range(values.shape[1])} if values.ndim == 2 else {name: values}
    rows = zip(*(values.tolist() for values in flat.values()), strict=True)
    path.write_text("\n".join([",".join(flat), *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return path


def test_csv_holds_the_same_log(tmp_path: Path) -> None:
    data = dataset_of_chains()
    content = lerobot(data) | {"next.terminated": data.terminated}
    content["next.observation.state"] = lists(data.next_observations)
    path = sheet(tmp_path / "log.csv", content)
    convert(str(path), str(tmp_path / "out.h5"), action_low=[-1], action_high=[1])
    assert_equal(load_dataset(tmp_path / "out.h5"), data)
    assert inspect_source(path).columns[0].shape == (9, 4)


BAD_CSV: dict[str, tuple[Callable[[str], str], str]] = {
    "text": (lambda text: text.replace("\n", "\nfast", 1), "'observation.state.0' holds text"),
    "an empty cell": (lambda text: text[: text.rindex(",") + 1] + "\n", "'next.done' holds text|0 or 1|NaN"),
    "a cell too many": (lambda text: text.replace("True\n", "True,1\n", 1), "is no CSV file"),
    "a row too short": (lambda text: text + "1.0,2.0\n", "NaN or infinite values|holds text"),
    "two of a name": (lambda text: text.replace("action.1", "action.0", 1), "has several columns named 'action.0'"),
    "a dimension missing": (lambda text: text.replace("action.1", "action.2", 1), "dimensions from 'action.0' to"),
    "nothing": (lambda text: "", "is no CSV file"),
    "other names": (lambda text: text.replace("observation.", "o."), "there are no 'observations'"),
    "bytes": (lambda text: "\0\1\n\0\0", "there are no 'observations'|is no CSV file"),
}


@pytest.mark.parametrize("name", BAD_CSV)
def test_a_bad_csv_is_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    break_it, sentence = BAD_CSV[name]
    path = sheet(tmp_path / "log.csv", lerobot(dataset_of_chains()))
    path.write_text(break_it(path.read_text()))
    with pytest.raises(UserError, match=sentence):
        convert(str(path), str(tmp_path / "out.h5"), action_low=[-1], action_high=[1])
    assert not (tmp_path / "out.h5").exists()


# hostile files


def nested(content: dict[str, Any]) -> None:
    content["observation.state"] = [[row] for row in content["observation.state"]]


def ragged(content: dict[str, Any]) -> None:
    content["action"][4] = [0.0]


def struct(content: dict[str, Any]) -> None:
    content["action"] = [{"x": a[0]} for a in content["action"]]


def null(content: dict[str, Any]) -> None:
    content["next.reward"] = [None, *content["next.reward"][1:].tolist()]


def inner_null(content: dict[str, Any]) -> None:
    content["action"][2][1] = None


def text(content: dict[str, Any]) -> None:
    content["next.reward"] = [str(value) for value in content["next.reward"]]


BAD: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "nested": (nested, r"'observation.state' holds list<.*list<"),
    "ragged": (ragged, r"'action' holds list<"),
    "struct": (struct, r"'action' holds struct"),
    "null": (null, r"'next.reward' holds double with 1 nulls: store numbers"),
    "inner null": (inner_null, r"'action' holds list<"),
    "text": (text, r"'next.reward' holds string"),
    "missing": (lambda content: content.pop("action"), "there are no 'actions'"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_log_is_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    break_it, sentence = BAD[name]
    content = lerobot(dataset_of_chains())
    break_it(content)
    path = table(tmp_path / "log.parquet", content)
    with pytest.raises(UserError, match=sentence):
        convert(str(path), str(tmp_path / "out.h5"), action_low=[-1], action_high=[1])
    assert any(finding.kind == "error" for finding in inspect_source(path).findings)
    assert not (tmp_path / "out.h5").exists()


def test_a_small_file_that_declares_a_large_log_is_refused(tmp_path: Path) -> None:
    rows = 40_000_000  # of one value: 40 MB in memory, and in the file some hundred bytes
    path = tmp_path / "bomb.parquet"
    pq.write_table(pa.table({"next.reward": pa.array(np.zeros(rows, np.int8))}), path, compression="zstd")
    assert path.stat().st_size < 1_000_000
    with pytest.raises(UserError, match=r"declares 320,000,000 of 'next.reward': it is damaged or a trap"):
        convert(str(path), str(tmp_path / "out.h5"))


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = table(tmp_path / "log.parquet", lerobot(dataset_of_chains()))
    whole = path.read_bytes()
    for content in (b"", b"PAR1", whole[: len(whole) // 2], whole[:200] + b"\xff" * 100 + whole[300:]):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"log\.parquet"):
            convert(str(path), str(tmp_path / "out.h5"))
    with pytest.raises(UserError, match="is not a file"):
        convert(str(tmp_path / "none.parquet"), str(tmp_path / "out.h5"))
    facts = pa.table(lerobot(dataset_of_chains())).replace_schema_metadata({"envtf_lit": "[1]"})
    pq.write_table(facts, path)
    with pytest.raises(UserError, match="the facts in its schema are no JSON object"):
        convert(str(path), str(tmp_path / "out.h5"))


def test_parquet_never_takes_a_files_place(tmp_path: Path) -> None:
    (tmp_path / "out.parquet").write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        convert(str(write(tmp_path / "in.npz", columns())), str(tmp_path / "out.parquet"))
    assert (tmp_path / "out.parquet").read_text() == "mine"


def test_parquet_without_its_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UserError, match=r"Parquet needs pyarrow .*: pip install 'envtf-lit\[parquet\]'\.$"):
        convert(str(write(tmp_path / "in.npz", columns())), str(tmp_path / "out.parquet"))
    assert not (tmp_path / "out.parquet").exists()
