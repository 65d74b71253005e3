"""Cloning of the better rows: by advantage, and of the best episodes alone."""

from typing import Any

import numpy as np
import pytest
import torch

from envtf_lit.agents.bc import best_rows
from envtf_lit.agents.wbc import WBC
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.sources.files import save_dataset
from tests.analytic import linear_data
from tests.hand_driven import B, hand_driven, make_batch

A = 2


def make_agent(**options: Any) -> Any:
    return hand_driven(WBC, action_dim=A, **options)


def test_beta_zero_is_behaviour_cloning() -> None:
    agent, batch = make_agent(beta=0.0), make_batch(A)
    torch.testing.assert_close(agent.actor_loss(batch)[0], agent.clone_loss(batch))


def test_weights_are_exponentials_of_scaled_advantages_cut_at_twenty() -> None:
    agent, batch = make_agent(beta=2.0), make_batch(A)
    batch["returns"][0] = 30.0
    advantage = batch["returns"] - agent.value(batch["observations"]).detach()
    weight = (2.0 * advantage / advantage.square().mean().sqrt()).exp().clamp(max=20.0)
    error = agent.actor.clone_error(batch["observations"], batch["actions"])
    torch.testing.assert_close(agent.actor_loss(batch)[0], (weight * error).mean())
    assert weight.max() == 20.0 and weight.min() < 1.0


def test_the_scale_of_returns_does_not_matter() -> None:
    agent, batch = make_agent(), make_batch(A)
    torch.nn.init.zeros_(agent.value.net[-1].weight)
    torch.nn.init.zeros_(agent.value.net[-1].bias)
    first = agent.actor_loss(batch)[0]
    torch.testing.assert_close(agent.actor_loss(batch | {"returns": 10.0 * batch["returns"]})[0], first)


def test_the_value_regresses_on_recorded_returns() -> None:
    agent, batch = make_agent(), make_batch(A)
    expected = (agent.value(batch["observations"]) - batch["returns"]).square().mean()
    torch.testing.assert_close(agent.value_loss(batch), expected)


def test_of_two_actions_the_better_one_is_cloned() -> None:
    """The same state, two actions equally often, one with the higher return."""
    agent = make_agent(beta=3.0, actor_learning_rate=0.01, critic_learning_rate=0.01)
    batch = make_batch(A) | {"observations": torch.zeros(B, 3)}
    good = torch.arange(B) < B // 2
    batch["actions"] = torch.where(good[:, None], 0.6, -0.6).expand(B, A).clone()
    batch["returns"] = torch.where(good, 1.0, -1.0)
    for _ in range(150):
        agent.update(batch)
        agent.update_index += 1
    assert agent.actor.act(torch.zeros(1, 3)).mean() > 0.4


def test_the_best_share_of_the_episodes_is_that_of_the_highest_returns() -> None:
    dataset = linear_data((5, 6, 7, 8, 9, 10, 11, 12, 13, 14))
    best = best_rows(dataset, 0.2)
    chosen = np.argsort(dataset.episode_returns)[-2:]
    assert torch.equal(best, torch.as_tensor(np.isin(dataset.episode_index, chosen)).float())
    assert best_rows(dataset, 0.01).sum() == dataset.episode_lengths[dataset.episode_returns.argmax()]
    assert best_rows(dataset, 1.0).all()


@pytest.mark.parametrize("temperature", [None, 0.5])
def test_rows_are_drawn_by_an_agents_chances(temperature: float | None, tmp_path) -> None:
    dataset = linear_data((20, 20, 20))
    save_dataset(dataset, tmp_path / "log.h5")
    data = TransitionData(str(tmp_path / "log.h5"), batch_size=64, steps_per_epoch=3, return_temperature=temperature)
    data.chances = best_rows(data.dataset, 0.34)
    (best,) = np.flatnonzero(dataset.episode_returns == dataset.episode_returns.max())
    known = {tuple(row) for row in dataset.observations[dataset.episode_index == best].tolist()}
    for batch in data.train_dataloader():
        assert {tuple(row) for row in batch["observations"].flatten(0, 1).tolist()} <= known
