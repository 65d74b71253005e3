"""`envtf data check` and `envtf data convert`: what is allowed and probably not meant, the report, the exit status."""

import io
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from logs import assert_equal, columns, write
from rich.console import Console
from walker import walker_dataset

from envtf_lit.cli.main import main
from envtf_lit.data.check_report import inspect_source, quality, render
from envtf_lit.data.conversion import convert
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.data.sources.minari import write_minari
from envtf_lit.errors import UserError


def said(dataset, **changes: np.ndarray) -> str:
    """The warnings about a dataset with some columns changed."""
    for name, values in changes.items():
        object.__setattr__(dataset, name, values)
    return "\n".join(f"{finding.kind}: {finding}" for finding in quality(dataset))


def test_a_sound_log_gives_no_warning():
    assert said(walker_dataset(episodes=12)) == ""


def test_few_and_single_step_episodes():
    assert "error: there is one episode" in said(walker_dataset(episodes=1))
    assert "warning: there are 4 episodes" in said(walker_dataset(episodes=4))
    assert "10 of 10 episodes are a single step" in said(walker_dataset(episodes=10, length=1))


def test_terminations_at_a_time_limit():
    dataset = walker_dataset()
    terminated = dataset.terminated | dataset.truncated
    assert "warning: 12 terminated episodes all have the greatest length, 20 steps" in said(
        dataset, terminated=terminated
    )


def test_terminations_at_different_lengths_are_none_of_a_time_limit():
    dataset = walker_dataset()
    starts = np.array([0, *range(15, 240, 20)])
    ends = np.zeros(240, bool)
    ends[np.append(starts[1:], 240) - 1] = True
    text = said(dataset, episode_starts=starts, terminated=ends, truncated=np.zeros(240, bool))
    assert "every episode is terminated" not in text
    assert "11 terminated episodes" in text  # all but the first and the last have twenty steps


def test_an_episode_end_without_a_flag_is_seen_as_a_gap():
    dataset = walker_dataset()
    starts = np.delete(dataset.episode_starts, 3)
    assert "1 rows inside episodes have a successor that is not the next row's state, first at row 59" in said(
        dataset, episode_starts=starts
    )


def test_successors_taken_from_the_next_episode_are_seen():
    dataset = walker_dataset()
    shifted = np.roll(dataset.observations, -1, axis=0)
    expected = f"warning: {len(dataset.episode_starts) - 1} of {len(dataset.episode_starts) - 1} ends of episodes have"
    assert expected in said(dataset, next_observations=shifted)


def test_constant_dimensions_and_rewards():
    dataset = walker_dataset()
    observations, actions = np.array(dataset.observations), np.array(dataset.actions)
    observations[:, [2, 5]], actions[:, 1] = 3.0, 0.0
    text = said(
        dataset, observations=observations, next_observations=observations, actions=actions, rewards=np.ones(240)
    )
    assert "note: 2 of 11 dimensions of 'observations' are constant in float32 (2, 5)" in text
    assert "warning: 1 of 3 dimensions of 'actions' are constant in float32 (1)" in text
    assert "every reward is 1" in text


def test_huge_values():
    dataset = walker_dataset()
    observations = np.array(dataset.observations)
    observations[7, 4] = -3e18
    text = said(dataset, observations=observations, rewards=1e9 * dataset.rewards)
    assert "'observations' reach a magnitude of 3e+18 in dimension 4" in text
    assert "'rewards' reach a magnitude of" in text


def test_repeated_rows():
    dataset = walker_dataset()
    twice = dataset.select([*range(12), 3, 4])
    assert "40 of 280 rows repeat the observation and action of another" in said(twice)


def test_the_report_shows_facts_and_problems_together(tmp_path: Path):
    content = columns() | {"metadata": np.zeros(3)}
    content["observations"][5, 2] = np.nan
    content["actions"] = content["actions"][:-1]
    inspection = inspect_source(write(tmp_path / "bad.npz", content))
    shown = io.StringIO()
    Console(file=shown, width=160).print(render(inspection))
    text = shown.getvalue()
    for part in (
        "observations       float32  (12, 11)",
        "not read: metadata",
        "11 rows",
        "row 5",
        "not usable: 2 errors",
    ):
        assert part in text


def test_check_prints_and_exits_by_what_it_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    save_dataset(walker_dataset(), tmp_path / "good.h5")
    main(["data", "check", str(tmp_path / "good.h5")])
    text = capsys.readouterr().out
    assert "240 transitions in 12 episodes of 20 to 20 steps" in text
    assert text.splitlines()[-1] == "usable"
    (tmp_path / "bad.h5").write_bytes(b"no")
    for arguments in (["bad.h5"], ["none.npz"], ["good.h5", "--task", "ant-medium"]):
        with pytest.raises(SystemExit) as stop:
            main(["data", "check", str(tmp_path / arguments[0]), *arguments[1:]])
        assert stop.value.code == 2
        assert "not usable: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "ours", "told"),
    [
        ("reward", "rewards", "rewards"),
        ("obs", "observations", "observations"),
        ("acts", "actions", "actions"),
        ("dones", "terminals", "terminals"),
        ("Truncations", "timeouts", "timeouts"),
    ],
)
def test_a_column_under_another_name_is_told_to_be_renamed(tmp_path: Path, name: str, ours: str, told: str):
    save_dataset(walker_dataset(), tmp_path / "log.npz")
    columns = dict(np.load(tmp_path / "log.npz"))
    np.savez(tmp_path / "odd.npz", **{name if key == ours else key: values for key, values in columns.items()})
    (note,) = [found for found in inspect_source(tmp_path / "odd.npz").findings if "is not read" in found.what]
    assert note.what == f"{name!r} is not read" and note.fix == f"if it is what we call {told!r}, rename it"
    np.savez(tmp_path / "both.npz", **columns, **{name: columns[ours]})
    assert not [found for found in inspect_source(tmp_path / "both.npz").findings if "is not read" in found.what]


def test_minari_datasets_are_checked_by_id_and_by_folder(minari_root: Path, capsys: pytest.CaptureFixture[str]):
    write_minari(walker_dataset(episodes=4), "my/walker-v0")
    for source in ("minari:my/walker-v0", str(minari_root / "my/walker-v0")):
        main(["data", "check", source])
        text = capsys.readouterr().out
        assert "80 transitions in 4 episodes of 20 to 20 steps" in text
        assert "warning: there are 4 episodes" in text
    with h5py.File(minari_root / "my/walker-v0/data/main_data.hdf5", "a") as file:
        for column, row in (("rewards", 3), ("observations", 5)):
            file[f"episode_1/{column}"][row] = np.nan  # pyright: ignore[reportIndexIssue]
    found = [finding.what for finding in inspect_source("minari:my/walker-v0").findings if finding.kind == "error"]
    assert [what.split(" has NaN")[0] for what in found] == ["'observations'", "'rewards'", "'next_observations'"]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("minari:my/none-v0", "no Minari dataset my/none-v0"),
        (".", "holds no Minari dataset"),
        ("minari:x", "not a Minari"),
    ],
)
@pytest.mark.usefixtures("minari_root")
def test_what_is_no_minari_dataset_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, message: str):
    monkeypatch.chdir(tmp_path)
    inspection = inspect_source(source)
    assert not inspection.usable
    assert message in inspection.findings[0].what
    with pytest.raises(UserError, match=message):
        convert(source, str(tmp_path / "out.h5"))


# convert


@pytest.mark.parametrize(("first", "second"), [(".h5", ".npz"), (".npz", ".hdf5")])
def test_convert_there_and_back_is_lossless(tmp_path: Path, first: str, second: str):
    save_dataset(walker_dataset(), tmp_path / f"a{first}")
    for source, target in ((f"a{first}", f"b{second}"), (f"b{second}", f"c{first}")):
        _, findings = convert(str(tmp_path / source), str(tmp_path / target))
        assert findings == []
    assert (tmp_path / f"c{first}").read_bytes() == (tmp_path / f"a{first}").read_bytes()
    assert_equal(load_dataset(tmp_path / f"b{second}"), walker_dataset())


@pytest.mark.usefixtures("minari_root")
def test_convert_to_minari_and_back(tmp_path: Path):
    save_dataset(walker_dataset(), tmp_path / "in.h5")
    assert convert(str(tmp_path / "in.h5"), "minari:my/walker-v0")[1] == []
    convert("minari:my/walker-v0", str(tmp_path / "out.h5"))
    assert (tmp_path / "out.h5").read_bytes() == (tmp_path / "in.h5").read_bytes()


@pytest.mark.usefixtures("minari_root")
def test_convert_counts_the_episodes_that_minari_cannot_hold(tmp_path: Path):
    dataset, findings = convert(str(write(tmp_path / "in.h5", columns())), "minari:noise-v0")
    said = "; ".join(map(str, findings))
    assert "9 episodes were split" in said
    assert "no task is named" in said
    again, _ = convert("minari:noise-v0", str(tmp_path / "out.npz"))
    assert len(again.episode_starts) == 12
    for name in ("observations", "actions", "rewards", "next_observations", "terminated"):
        assert np.array_equal(getattr(again, name), getattr(dataset, name))


def test_convert_states_the_limits_that_a_file_does_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    content = columns()
    content["actions"] *= np.float32(0.3)
    source, target = write(tmp_path / "in.h5", content), tmp_path / "out.h5"
    with pytest.raises(SystemExit):
        main(["data", "convert", str(source), str(target)])
    assert "state the robot's own" in capsys.readouterr().err and not target.exists()
    main(["data", "convert", str(source), str(target), "--action-low", "-0.4", "--action-high", "0.4", "0.5", "0.4"])
    dataset = load_dataset(target)
    assert dataset.action_low.tolist() == [np.float32(-0.4)] * 3
    assert dataset.action_high.tolist() == np.array([0.4, 0.5, 0.4], np.float32).tolist()


@pytest.mark.usefixtures("minari_root")
def test_convert_keeps_the_split_or_says_that_it_does_not(tmp_path: Path):
    dataset = walker_dataset().with_split(0.2, seed=0)
    save_dataset(dataset, tmp_path / "in.h5")
    kept, findings = convert(str(tmp_path / "in.h5"), str(tmp_path / "out.npz"))
    assert_equal(load_dataset(tmp_path / "out.npz"), dataset)
    assert_equal(kept, dataset)
    assert not findings
    _, findings = convert(str(tmp_path / "in.h5"), "minari:walker-v0")
    assert "which episodes are held out is left behind" in "; ".join(map(str, findings))


def test_convert_says_what_it_changes_and_leaves_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    content = columns() | {"infos/qpos": np.zeros((12, 6)), "rewards": columns()["rewards"].astype(np.float64)}
    del content["next_observations"]
    main(["data", "convert", str(write(tmp_path / "in.h5", content)), str(tmp_path / "out.npz")])
    text = capsys.readouterr().out
    for part in (
        "Wrote 9 transitions",
        "is float64 and becomes float32",
        "the last row of each of 3 episodes",
        "infos",
    ):
        assert part in text


def test_convert_refuses_what_is_there_and_what_it_cannot_read(tmp_path: Path):
    content = columns()
    content["rewards"][0] = np.nan
    bad = write(tmp_path / "in.h5", content)
    with pytest.raises(UserError, match="lists all that is wrong"):
        convert(str(bad), str(tmp_path / "out.npz"))
    with pytest.raises(UserError, match="exists already"):
        convert(str(bad), str(bad))
    with pytest.raises(UserError, match="name a dataset"):
        convert(str(bad), str(tmp_path / "out.csv"))
    assert [path.name for path in tmp_path.iterdir()] == ["in.h5"]


def test_a_converted_file_names_its_task(tmp_path: Path):
    save_dataset(walker_dataset(), tmp_path / "in.h5")
    with h5py.File(tmp_path / "in.h5", "a") as file:
        del file.attrs["task"]
    convert(str(tmp_path / "in.h5"), str(tmp_path / "out.h5"), task="hopper-medium")
    assert load_dataset(tmp_path / "out.h5").task == "hopper-medium"


def test_one_wild_value_is_named_with_its_place():
    """By the spread of all others: a standard deviation would be the wild value's own."""
    dataset = walker_dataset()
    observations, rewards = np.array(dataset.observations), np.array(dataset.rewards)
    observations[27, 4], observations[45:47, 6] = 4e3, -5e6
    rewards[100] = 2e7
    text = said(dataset, observations=observations, rewards=rewards)
    assert re.search(r"'observations' is 4000 in dimension 4 at row 27, \S+ times the spread away", text)
    assert "'observations' is -5e+06 in dimension 6 at row 45," in text and "(2 rows are as far)" in text
    assert re.search(r"'rewards' is 2e\+07 at row 100, .*drop episode 5 \(rows 100 to 119\): else it sets", text)
    assert text.count("times the spread") == 3


def test_sound_values_are_not_called_wild():
    """Whatever their unit, however rarely a dimension moves, and where heavy tails are its nature."""
    dataset = walker_dataset(100)
    random = np.random.default_rng(0)
    observations = np.array(dataset.observations)
    observations[:, 1] = random.standard_t(2, len(observations))
    observations[:, 2], observations[3, 2] = 0.0, 1.0  # moves once
    observations[:, 3] = (random.random(len(observations)) < 0.03) * 1e-9
    observations[:, 4] = 7.0
    observations[:, 5] *= 1e9
    text = said(dataset, observations=observations)
    assert "times the spread" not in text
    observations[9, 4] = 1e5  # beside a constant
    assert "'observations' is 1e+05 in dimension 4 at row 9" in said(dataset, observations=observations)
