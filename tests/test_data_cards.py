"""What a card says of a dataset: which episodes count, and in which unit."""

import numpy as np
import pytest

from envtf_lit.data.cards import card_page, counted_episodes, cut_short, dataset_card
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.robots.tasks import ROBOTS

LENGTHS, FELL = (1000, 400, 300, 999), (False, True, False, False)  # the last two are cut short


def recorded(task: str | None = "hopper-medium", kept: slice = slice(None)) -> OfflineDataset:
    """A reward of one at each step, so that an episode's return is its length."""
    lengths = np.array(LENGTHS)[kept]
    ends, rows = np.cumsum(lengths), int(lengths.sum())
    terminated, truncated = np.zeros((2, rows), bool)
    terminated[ends - 1] = np.array(FELL)[kept]
    truncated[ends - 1] = ~np.array(FELL)[kept]
    return OfflineDataset(
        observations=np.zeros((rows, 11), np.float32),
        actions=np.zeros((rows, 3), np.float32),
        rewards=np.ones(rows, np.float32),
        next_observations=np.zeros((rows, 11), np.float32),
        terminated=terminated,
        truncated=truncated,
        episode_starts=ends - lengths,
        action_low=-np.ones(3, np.float32),
        action_high=np.ones(3, np.float32),
        task=task,
    )


@pytest.mark.parametrize(
    ("source", "task", "expected"),
    [
        ("zoo", "hopper-medium", [False, False, True, True]),
        ("d4rl", "hopper-medium-v4", [False, False, True, True]),
        ("file", "hopper-medium", [False] * 4),  # may have been recorded under a time limit of 300
        ("minari", "hopper-medium", [False] * 4),
        ("file", None, [False] * 4),
    ],
)
def test_an_episode_is_cut_short_if_it_neither_fell_nor_reached_the_time_limit(
    source: str, task: str | None, expected: list[bool]
) -> None:
    dataset = recorded(task)
    assert cut_short(dataset, source).tolist() == expected
    assert counted_episodes(dataset, source).tolist() == [not cut for cut in expected]


def test_episodes_cut_short_are_marked_and_left_out_of_the_statistics() -> None:
    card = dataset_card(recorded(), "zoo", {})
    assert (card["episodes"], card["terminated"], card["truncated"], card["cut_short"]) == (4, 1, 3, 2)
    assert card["returns"]["mean"] == 700
    assert card["episode_steps"] == {"min": 400, "mean": 700.0, "max": 1000}
    assert card["scores"]["mean"] == pytest.approx(ROBOTS["hopper"].normalised_score(700))


def test_where_all_are_cut_short_all_count() -> None:
    card = dataset_card(recorded(kept=slice(2, None)), "zoo", {})
    assert (card["episodes"], card["cut_short"]) == (2, 2)
    assert card["returns"]["mean"] == 649.5


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (slice(None), "3 were truncated (2 of them cut short where a policy's rows end, and left out below)"),
        (slice(2, None), "2 were truncated (2 of them cut short where a policy's rows end)"),
        (slice(2), "1 were truncated |"),
    ],
)
def test_the_page_says_so(kept: slice, words: str) -> None:
    origin = dict(env_kwargs={}, seed=0, actions="", trained_with="", versions={}, policies=[], note="")
    assert words in card_page(dataset_card(recorded(kept=kept), "zoo", origin))


def test_minaris_returns_get_no_score() -> None:
    card = dataset_card(recorded(), "minari", {})
    assert "scores" not in card
    assert card["returns"]["max"] == 1000


def test_limits_and_held_out_episodes_are_in_the_card() -> None:
    card = dataset_card(recorded().with_split(0.5, seed=0), "file", {})
    assert (card["action_low"], card["action_high"]) == ([-1.0] * 3, [1.0] * 3)
    assert card["held_out_episodes"] == 2
    assert "held_out_episodes" not in dataset_card(recorded(), "file", {})
    origin = dict(env_kwargs={}, seed=0, actions="stochastic", trained_with="", versions={}, policies=[], note="")
    assert "| actions | stochastic, in [-1, 1] |" in card_page(dataset_card(recorded(), "zoo", origin))
