"""The record of many environments: episodes in the order they began, resets dropped, cut where the rows end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.zoo.record import _Log


def log_of(endings: Sequence[Sequence[str]]) -> _Log:
    """A log of environments whose steps are given as letters: `.` goes on, `t` terminates, `c` is the time limit."""
    robot = replace(ROBOTS["hopper"], observation_dim=1, action_dim=1)
    log = _Log(robot, len(endings))
    for step, letters in enumerate(zip(*endings, strict=True)):
        values = np.arange(len(letters)) + 10.0 * step
        log.append(
            observations=values[:, None],
            actions=values[:, None],
            rewards=values,
            next_observations=values[:, None] + 10,
            terminated=np.array([letter == "t" for letter in letters]),
            truncated=np.array([letter == "c" for letter in letters]),
        )
    return log


def test_the_log_keeps_episodes_in_the_order_they_began_and_drops_resets():
    log = log_of(["..t#...", ".....c#"])  # what stands at # is the automatic reset
    assert log.usable_rows() == 3 + 6 + 3
    columns = log.cut(11)
    assert columns["rewards"].tolist() == [0, 10, 20, 1, 11, 21, 31, 41, 51, 40, 50]
    assert np.flatnonzero(columns["terminated"]).tolist() == [2]
    assert np.flatnonzero(columns["truncated"]).tolist() == [8, 10]


def test_a_running_episode_closes_the_usable_ones():
    """Later ones, though finished, would make short episodes too frequent."""
    log = log_of([".....", ".t#.t"])
    assert log.usable_rows() == 5
    assert log.cut(4)["truncated"].tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    ("rows", "ends"),
    [
        (5, [4]),  # exactly one whole episode
        (7, [4, 6]),  # the second one is cut
        (6, [3, 5]),  # a lone row is no episode: the first one gives one up
    ],
)
def test_cut(rows: int, ends: list[int]):
    columns = log_of(["....t", "....."]).cut(rows)
    assert len(columns["rewards"]) == rows
    assert np.flatnonzero(columns["terminated"] | columns["truncated"]).tolist() == ends
    assert columns["terminated"].any() == (ends[0] == 4)


def test_the_log_grows():
    log = log_of(["." * 3_000])
    assert log.cut(2_999)["rewards"].tolist() == [10.0 * step for step in range(2_999)]
