"""Trust: the clone that is likeliest on held-out rows, the constraint's weight, promises, and who is published."""

import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.agents import trust as trust_module
from envtf_lit.agents.et_cql import ETCQL, ETCQLOptions, GuardedRolloutOptions
from envtf_lit.agents.frontier import Frontier
from envtf_lit.agents.phases import Batch
from envtf_lit.agents.trust import Trust
from envtf_lit.agents.trust_levels import LEAST_GAIN, LEVELS
from envtf_lit.agents.value_gradient import ImaginedPaths, ValueGradientOptions
from envtf_lit.critics import StackedCritics
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.loaders import DrawnRows, Transitions
from envtf_lit.imagination import promise as promise_module
from envtf_lit.imagination.histories import BranchPoints
from envtf_lit.imagination.promise import Promise, promised
from envtf_lit.world_models.interface import Prediction
from tests.analytic import LinearWorld, linear_data, linear_world
from tests.hand_driven import EPISODES, flat, hand_driven, imagination, imagined_batches

CPU = torch.device("cpu")


def make_actor(seed: int = 0) -> TanhGaussianActor:
    torch.manual_seed(seed)
    return TanhGaussianActor(3, 1, hidden=(8, 8))


def rows_of(data: OfflineDataset) -> DrawnRows:
    return DrawnRows(Transitions(data, discount=0.9))


def small() -> dict[str, Any]:
    """Options that leave 54 of 60 updates to the clone."""
    gradient = ValueGradientOptions(updates=2, horizon=2)
    return dict(rollouts=GuardedRolloutOptions(history=2), value_gradient=gradient, critic_updates=4)


def alike(rows: Batch) -> Tensor:
    return torch.ones(len(rows["returns"]))


def learned_by_heart() -> Batch:
    """Four rows; held-out actions are uniform."""
    data, few = linear_data(EPISODES), torch.arange(4)
    return dict(
        observations=torch.as_tensor(data.observations)[few],
        actions=torch.full((4, 1), 0.9),
        rewards=torch.zeros(4),
        returns=torch.arange(4.0),
        tails=torch.zeros(4),
        last_observations=torch.as_tensor(data.next_observations)[few],
    )


def watching(actor: TanhGaussianActor) -> Trust:
    trust = Trust(actor)
    trust.begin(rows_of(linear_data(EPISODES)), alike, 0, CPU)
    return trust


def sure(action: float) -> TanhGaussianActor:
    """An actor of one action, narrowly spread."""
    actor = make_actor()
    last: Any = actor.net[-1]
    nn.init.zeros_(last.weight)
    last.bias.data.copy_(torch.tensor([math.atanh(action), -3.0]))
    return actor


# the clone


def test_the_clone_is_the_actor_that_was_likeliest_on_held_out_rows():
    actors = [make_actor(seed) for seed in range(5)]
    trust = watching(actors[0])
    errors = [float(trust.look(actor)) for actor in actors]
    assert float(trust.best) == pytest.approx(min(errors))
    assert torch.equal(flat(trust.clone.state_dict()), flat(actors[errors.index(min(errors))].state_dict()))
    assert trust.excess(actors[0]) == pytest.approx(errors[0] - min(errors), abs=1e-5)
    assert errors[0] == float(trust.look(actors[0]))  # the same rows at each look


def test_a_clone_that_explains_the_actions_is_the_first_of_a_better_kind():
    """From there on least squares are part of its loss, and the likelihood before no longer counts."""
    data = linear_data(EPISODES)
    actor = make_actor()
    decided = replace(data, actions=actor.act(torch.as_tensor(data.observations)).numpy())
    trust = Trust(actor)
    trust.begin(rows_of(decided), alike, 0, CPU)
    other = sure(0.0)
    trust.look(other)
    assert not trust.determined
    trust.best.fill_(-100.0)  # a likelihood that no spread of `actor` reaches
    trust.look(actor)
    assert trust.determined and float(trust.best) > -100.0
    assert torch.equal(flat(trust.clone.state_dict()), flat(actor.state_dict()))
    best = float(trust.best)
    trust.look(other)
    assert trust.determined and float(trust.best) == best


def test_the_warm_start_ends_with_the_clone_not_with_what_was_learned_by_heart(monkeypatch):
    monkeypatch.setattr(trust_module, "CHECK_EVERY", 10)
    monkeypatch.setattr(trust_module, "LEARNING_RATE", 0.03)
    agent = hand_driven(ETCQL, source=imagined_batches(), beta=0.0, **small())
    batch, seen = learned_by_heart(), []
    for _ in range(54):
        agent.update(batch)
        agent.update_index += 1
        seen.append(float(agent.trust.look(copy.deepcopy(agent.actor))))
    assert float(agent.trust.best) == pytest.approx(min(seen), abs=1e-6) and seen[52] > min(seen) + 0.1
    assert torch.equal(flat(agent.actor.state_dict()), flat(agent.trust.clone.state_dict()))
    assert torch.equal(flat(agent.average_actor.state_dict()), flat(agent.trust.clone.state_dict()))


def test_the_clone_is_judged_by_the_rows_that_it_learned_from():
    """Two actions in the same states; the rows of one went on better."""
    data = linear_data((1,) * 400)
    good = torch.arange(400) < 200
    actions = torch.where(good, 0.6, -0.6)[:, None].numpy()
    rows = rows_of(replace(data, actions=actions, rewards=torch.where(good, 1.0, -1.0).numpy()))
    errors = []
    for weight in (0.0, 1.0):
        trust = Trust(make_actor())
        trust.begin(rows, lambda batch, weight=weight: 1.0 + weight * (20.0 * (batch["returns"] > 0) - 1.0), 0, CPU)
        errors.append([float(trust.look(sure(action))) for action in (0.6, -0.6)])
    assert errors[0][0] == pytest.approx(errors[0][1], rel=0.2)
    assert errors[1][0] < 0.0 < errors[1][1]


@pytest.mark.parametrize("determined", [False, True])
def test_better_rows_are_cloned_more_where_states_leave_a_choice(determined):
    agent = hand_driven(ETCQL, source=imagined_batches(), **small(), beta=2.0)
    agent.trust.determined.fill_(determined)
    returns = torch.tensor([0.0, 1.0, 2.0])
    batch = dict(observations=torch.zeros(3, 3), returns=returns)
    weights = agent.row_weights(batch)
    assert bool((weights.diff() > 0).all()) is not determined and bool((weights == 1).all()) is determined


def test_the_warm_starts_clone_is_no_distance_from_itself(monkeypatch):
    """Its rows weighed something else when it was looked at: the values that weigh them have learned since."""
    monkeypatch.setattr(trust_module, "CHECK_EVERY", 10)
    monkeypatch.setattr(trust_module, "LEARNING_RATE", 0.03)
    agent = hand_driven(ETCQL, source=imagined_batches(), **small())
    for _ in range(54):
        agent.update(learned_by_heart())
        agent.update_index += 1
    assert agent.trust.excess(agent.actor) == pytest.approx(0.0, abs=1e-6)


# the constraint


def test_the_weight_of_cloning_grows_while_the_constraint_is_broken():
    trust = watching(make_actor())
    trust.look(make_actor())
    far, generator = sure(0.99), torch.Generator().manual_seed(0)
    before = float(trust.log_weight.exp())
    grown = float(trust.ascend(far, 0.1, generator))
    assert grown > before
    for _ in range(100):
        trust.ascend(far, 0.1, generator)
    assert float(trust.log_weight.exp()) == pytest.approx(trust_module.MOST)
    assert float(trust.ascend(far, 1e4, generator)) < trust_module.MOST


def test_levels_of_trust_reach_further_and_further():
    cautious, default, bold = (LEVELS[name] for name in ("cautious", "default", "bold"))
    assert cautious.slack < default.slack < bold.slack
    assert (cautious.believes, default.believes, bold.believes) == (False, False, True)


@pytest.mark.parametrize(("level", "halted"), [("default", True), ("bold", False)])
def test_a_path_is_lost_where_it_is_promised_more_than_was_ever_paid(level, halted):
    imagined = imagination()
    imagined.reward_range = -1e9, -1e8
    paths = ImaginedPaths(imagined, ValueGradientOptions(rollouts=4, horizon=3), believes=LEVELS[level].believes)
    assert bool(paths.next(make_actor(), torch.ones(()), torch.Generator().manual_seed(0)).halted.all()) is halted


def test_noise_alone_promises_no_more_than_was_paid():
    """The model's rewards have a deviation of .1."""
    imagined = imagination()
    imagined.reward_range = -1.0, 0.0
    sums = torch.tensor([0.05, 0.09, 0.11, 0.3])
    _, prediction = linear_world().step(
        sums[:, None] * torch.tensor([[1.0, 0.0, 0.0]]),
        torch.zeros(4, 1),
        mode="sample",
        generator=torch.Generator().manual_seed(0),
    )
    assert imagined.overpaid(prediction).tolist() == [False, False, True, True]


# promises


class Still:
    """A policy that does nothing."""

    def act(self, observation: Tensor, deterministic: bool = False, generator: torch.Generator | None = None) -> Tensor:
        assert deterministic
        return torch.zeros(len(observation), 1)


def test_a_promise_is_the_mean_return_of_whole_imagined_episodes():
    """The longest episode was cut after 40 steps; states turn by .1 per step, and rewards are their sums."""
    imagined = imagination()
    imagined.reward_range = -100.0, 100.0
    found = promised(imagined, Still(), episodes=300, generator=torch.Generator().manual_seed(0))
    firsts = torch.as_tensor(linear_data(EPISODES).observations)[[0, 30]]
    returns = []
    for first in firsts:
        state, total = first, 0.0
        for _ in range(40):
            total += float(state.sum())
            state = linear_world().matrix @ state
        returns.append(total)
    assert abs(found.mean - sum(returns) / 2) < 4 * found.error
    assert found.error == pytest.approx(abs(returns[0] - returns[1]) / 2 / math.sqrt(300), rel=0.05)
    assert (found.low, found.high) == pytest.approx((min(returns), max(returns)), abs=1.0)
    assert found.lost == 0.0 and found.steps == 40.0


def test_promises_end_with_the_fall_and_count_no_more_than_was_ever_paid():
    imagined = imagination(fall_beyond=-1e9)  # all fall at once
    imagined.starts = BranchPoints(linear_data((1,) * 9))
    imagined.reward_range = -1.0, 0.0
    found = promised(imagined, Still(), episodes=50, generator=torch.Generator().manual_seed(0))
    assert -1.0 <= found.mean <= 0.0
    assert 0.0 < found.lost < 1.0 and found.steps == 1.0  # steps that were promised more


def test_episodes_that_fell_say_nothing_about_a_time_limit(monkeypatch):
    monkeypatch.setattr(promise_module, "LONGEST", 70)
    imagined, steps = imagination(), []
    fell = imagined.terminated
    imagined.terminated = lambda states: steps.append(1) or fell(states)
    for cut_short, length in ((True, 40), (False, 70)):
        steps.clear()
        imagined.cut_short = cut_short
        promised(imagined, Still(), episodes=2, generator=torch.Generator().manual_seed(0))
        assert len(steps) == length


# who is published


@pytest.mark.parametrize(
    ("promises", "errors", "price", "kept"),
    [
        ([100.0, 103.0, 104.0], [1.0, 1.0, 1.0], 0.0, 0),  # not worth leaving the log for
        ([100.0, 120.0, 130.0], [1.0, 1.0, 1.0], 0.0, 2),
        ([100.0, 120.0, 130.0], [1.0, 1.0, 1.0], 1.2, 1),  # 0.19 - 0.12 against 0.29 - 0.24
        ([100.0, 120.0, 130.0], [1.0, 1.0, 1.0], 3.0, 0),
        ([100.0, 120.0, 130.0], [1.0, 1.0, 20.0], 0.0, 1),  # promised with more doubt
        ([100.0, 90.0, 80.0], [1.0, 1.0, 1.0], 0.0, 0),
        ([-100.0, -98.0, -50.0], [1.0, 1.0, 1.0], 1.0, 2),
        ([-100.0, -98.0, -97.0], [1.0, 1.0, 1.0], 0.0, 0),
    ],
)
def test_the_log_is_left_for_a_clear_gain_alone(promises, errors, price, kept):
    actors = [make_actor(seed) for seed in range(3)]
    critics = [StackedCritics(3, 1, hidden=(8,), layer_norm=False) for _ in range(3)]
    frontier = Frontier(actors[0], critics[0], 4)
    for place, (mean, error) in enumerate(zip(promises, errors, strict=True)):
        promise = Promise(mean, error, low=0.0, high=200.0, lost=0.01, steps=9.0)
        frontier.add(actors[place], critics[place], update=place, excess=0.1 * place, promise=promise)
    chosen = frontier.choose(price)
    assert torch.equal(flat(chosen.state_dict()), flat(actors[kept].state_dict()))
    assert torch.equal(flat(frontier.critics[kept].state_dict()), flat(critics[kept].state_dict()))
    rows = frontier.rows()
    assert [row["kept"] for row in rows] == [int(place == kept) for place in range(3)]
    assert [row["promise"] for row in rows] == promises and rows[2]["excess"] == pytest.approx(0.2)
    assert 0.0 < LEAST_GAIN < 0.2


class Lavish(LinearWorld):
    """Promises ten times what is ever paid, for actions beyond a half, which the log does not know."""

    def step(self, state: Tensor, action: Tensor, **options: Any) -> tuple[Tensor, Prediction]:
        following, found = super().step(state, action, **options)
        bonus = 100.0 * (action[:, 0] - 0.5).clamp(min=0.0)
        return following, replace(found, reward=torch.tanh(action[:, 0]) + bonus)


@pytest.mark.parametrize("level", ["default", "bold"])
def test_a_whole_training_publishes_what_its_trust_allows(level):
    """Rewards grow with the action; those of the log are at most a half, and so are its actions."""
    options: dict[str, Any] = dict(
        rollouts=GuardedRolloutOptions(history=2), value_gradient=ValueGradientOptions(updates=40, horizon=4)
    )
    source = imagined_batches()
    source.imagination.model = Lavish(**vars(linear_world()))
    source.imagination.reward_range = -0.5, 0.5
    agent = hand_driven(ETCQL, source=source, trust=level, critic_updates=5, discount=0.9, **options)
    data = linear_data(EPISODES)
    batch = dict(
        observations=torch.as_tensor(data.observations),
        actions=torch.as_tensor(data.actions) * 0.5,
        rewards=torch.zeros(70),
        returns=torch.zeros(70),
        tails=torch.zeros(70),
        discounts=torch.zeros(70),
    )
    for name in ("last_observations", "next_observations", "following_observations"):
        batch[name] = torch.as_tensor(data.next_observations)
    agent.source.begin(torch.ones(()))
    for _ in range(60):
        agent.update(batch)
        agent.update_index += 1
    rows = agent.records()["frontier"]
    assert [row["update"] for row in rows] == [0.0, 10.0, 20.0, 30.0, 40.0]
    kept = next(place for place, row in enumerate(rows) if row["kept"])
    assert torch.equal(flat(agent.average_actor.state_dict()), flat(agent.frontier.actors[kept].state_dict()))
    published = agent.published_critics()
    assert torch.equal(flat(published.stack.state_dict()), flat(agent.frontier.critics[kept].state_dict()))
    assert rows[-1]["excess"] < LEVELS[level].slack + 0.3
    (clone,) = agent.companions().values()
    assert torch.equal(flat(clone.state_dict()), flat(agent.frontier.actors[0].state_dict()))


def test_an_unknown_level_of_trust_is_refused():
    from envtf_lit.errors import UserError
    from envtf_lit.options.schema import build

    with pytest.raises(UserError, match="trust is 'brave': choose from bold, cautious, default"):
        build(ETCQLOptions, {"trust": "brave"}, "train_policy.x")
