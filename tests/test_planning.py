"""Planners: beside Riccati's optimum and pytorch-mppi, their memory, and their caution."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.planning.noise import coloured_noise
from envtf_lit.planning.objective import Objective, imagined_paths
from envtf_lit.planning.options import (
    CEMOptions,
    GradientOptions,
    ICEMOptions,
    MPPIOptions,
    PlannerOptions,
    RandomShootingOptions,
)
from envtf_lit.planning.registry import PLANNERS
from envtf_lit.planning.shooting import CEM, MPPI
from envtf_lit.policy import StatefulPolicy
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.robots.tasks import ROBOTS
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer
from tests.analytic import LinearWorld

# a double integrator, whose cost s'Qs + 0.1 a^2 has a known optimum

STEP = 0.2
MATRIX, GAIN = torch.tensor([[1.0, STEP], [0.0, 1.0]]), torch.tensor([[0.0], [STEP]])
EFFORT, BEGIN, STEPS = 0.1, torch.tensor([[1.0, 0.0], [-0.6, 0.8]]), 20
BOUNDS: tuple[list[float], list[float]] = ([-4.0], [4.0])


def double_integrator() -> LinearWorld:
    return LinearWorld(MATRIX, GAIN, observation_dim=2)


def reward(state: Tensor, action: Tensor, following: Tensor) -> Tensor:
    return -(state.square().sum(-1) + EFFORT * action.square().sum(-1))


@cache
def riccati() -> Tensor:
    """P of the optimal cost to go s'Ps, by iterating Riccati's equation to its fixed point."""
    cost = torch.eye(2)
    for _ in range(500):
        gain = torch.linalg.solve(EFFORT + GAIN.T @ cost @ GAIN, GAIN.T @ cost @ MATRIX)
        cost = torch.eye(2) + MATRIX.T @ cost @ (MATRIX - GAIN @ gain)
    return cost


def to_go(state: Tensor) -> Tensor:
    return -((state @ riccati()) * state).sum(-1)


def linear_quadratic(name: str, options: PlannerOptions, **further: Any) -> Any:
    return PLANNERS[name](double_integrator(), *BOUNDS, options, reward=reward, value=to_go, **further)


def cost_of(policy: Any) -> Tensor:
    """(2,) what the first steps from both beginnings cost, and what is still to come of the last state."""
    world, state, cost = double_integrator(), BEGIN, torch.zeros(2)
    for _ in range(STEPS):
        action = policy.act(state)
        cost = cost - reward(state, action, state)
        state, _ = world.step(state, action)
    return cost - to_go(state)


ACCURATE: dict[str, tuple[PlannerOptions, float]] = {
    "random": (RandomShootingOptions(horizon=2, discount=1.0, samples=1_000), 1.05),
    "cem": (CEMOptions(horizon=6, discount=1.0, iterations=6), 1.03),
    "icem": (ICEMOptions(horizon=6, discount=1.0, colour=1.0), 1.02),
    "mppi": (MPPIOptions(horizon=6, discount=1.0, std=0.2, temperature=0.05), 1.05),
    "gradient": (GradientOptions(horizon=6, discount=1.0, samples=4, iterations=15, learning_rate=0.1), 1.02),
}


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_is_near_the_optimum_of_a_linear_quadratic_problem(name: str):
    options, bound = ACCURATE[name]
    ratio = cost_of(linear_quadratic(name, options)) / -to_go(BEGIN)
    assert (ratio > 0.999).all() and (ratio < bound).all(), ratio


def test_mppi_costs_what_that_of_pytorch_mppi_costs():
    """Ours leaves the cost of control out, which the library weighs by the temperature; a low one makes it small."""
    from pytorch_mppi import MPPI as Theirs

    temperature, std = 0.02, 0.8
    torch.manual_seed(0)
    costs = torch.zeros(2)
    for row in range(2):
        theirs = Theirs(
            lambda s, a: s @ MATRIX.T + a @ GAIN.T,
            lambda s, a: -reward(s, a, s),
            2,
            torch.eye(1) * std**2,
            num_samples=256,
            horizon=10,
            lambda_=temperature,
            u_min=torch.tensor(BOUNDS[0]),
            u_max=torch.tensor(BOUNDS[1]),
        )
        state = BEGIN[row]
        for _ in range(STEPS):
            action = theirs.command(state)
            costs[row] -= reward(state, action, state)
            state = state @ MATRIX.T + action @ GAIN.T
        costs[row] -= to_go(state)
    options = MPPIOptions(horizon=10, discount=1.0, samples=256, std=std / 4, temperature=temperature)
    ours = cost_of(MPPI(double_integrator(), *BOUNDS, options, reward=reward))
    torch.testing.assert_close(ours, costs, rtol=0.1, atol=0.0)


# what a plan is worth


class Paid(LinearWorld):
    """A world that pays its first action and tells what was made up of its novelty and uncertainty."""

    def step(self, state: Tensor, action: Tensor, **options: Any) -> tuple[Tensor, Prediction]:
        following, prediction = super().step(state, action, **options)
        told = dict(reward=action[:, 0], uncertainty=action[:, 0].abs(), novelty=following[:, 0].abs())
        return following, replace(prediction, **told)


def worth(plan: list[list[float]], *, fall_beyond: float = torch.inf, **options: Any) -> list[float]:
    """J of plans from the origin, in a world where each action adds itself to the first dimension."""
    value, prior = options.pop("value", None), options.pop("prior", None)
    world = Paid(torch.eye(3), torch.tensor([[1.0], [0.0], [0.0]]))
    settings = PlannerOptions(horizon=len(plan[0]), **options)
    objective = Objective(world, settings, lambda s: s[..., 0] > fall_beyond, None, value, prior)
    return objective.returns(torch.zeros(1, 3), torch.tensor(plan)[None, ..., None])[0].tolist()


def test_rewards_are_discounted_and_the_value_of_the_end_follows():
    assert worth([[1.0, 2.0, 3.0]], discount=0.5) == [1 + 1 + 0.75]
    assert worth([[1.0, 2.0, 3.0]], discount=0.5, value=lambda s: 10 * s[:, 0]) == [2.75 + 60 / 8]


class Forwards:
    """Always one to the first dimension."""

    def act(self, observation: Tensor, deterministic: bool = True, generator: Any = None) -> Tensor:
        return torch.ones(len(observation), 1)


def test_in_the_tail_the_prior_goes_on():
    found = worth([[1.0, 2.0]], discount=0.5, tail=2, prior=Forwards(), value=lambda s: 8 * s[:, 0])
    assert found == [1 + 1 + 0.25 + 0.125 + 8 * 5 / 16]
    assert worth([[1.0, 2.0]], discount=1.0, tail=9, prior=Forwards(), fall_beyond=3.5) == [4.0]


def test_nothing_follows_a_fall_but_the_step_into_it_counts():
    plans = [[1.0, 2.0, 3.0], [1.0, 0.5, 0.5]]
    assert worth(plans, fall_beyond=2.5, discount=1.0, value=lambda s: s[:, 0] * 0 + 100) == [3.0, 102.0]


def test_uncertainty_costs_its_penalty():
    assert worth([[1.0, -2.0]], discount=1.0, penalty=0.5) == [-1 - 0.5 * 3]


def test_what_the_model_does_not_know_counts_as_the_worst_that_any_candidate_met():
    """The second candidate is lost at its second step: that one, the third and the end count as the worst beside it."""
    plans = [[-0.5, -0.5, -0.5], [0.5, 1.0, 0.0], [0.5, 0.0, 0.0]]
    found = worth(plans, discount=1.0, novelty_limit=1.49, value=lambda s: s[:, 0])
    assert found[1:] == [0.5 + 2 * -0.5 + 0.5, 0.5 + 0.5]


def test_a_plan_that_is_not_finite_is_the_worst_of_all():
    assert worth([[float("nan"), 1.0], [1.0, 1.0]], discount=1.0) == [-torch.inf, 2.0]


def test_paths_are_those_of_the_plans():
    world, plans = double_integrator(), torch.randn(2, 3, 4, 1, generator=torch.Generator().manual_seed(0))
    paths = imagined_paths(world, BEGIN, plans)
    state = BEGIN[1]
    for t in range(5):
        torch.testing.assert_close(paths[1, 2, t], state)
        state = state @ MATRIX.T + plans[1, 2, min(t, 3)] @ GAIN.T


# noise


@pytest.mark.parametrize("steps", [1, 2, 7, 12])
@pytest.mark.parametrize("colour", [0.0, 1.0, 2.0])
def test_coloured_noise_has_unit_variance_at_every_step(steps: int, colour: float):
    draw = lambda: coloured_noise(  # noqa: E731
        20_000, steps, 1, colour=colour, generator=torch.Generator().manual_seed(0), device=torch.device("cpu")
    )
    noise = draw()
    assert noise.shape == (20_000, steps, 1) and torch.equal(noise, draw())
    torch.testing.assert_close(noise.std(0), torch.ones(steps, 1), rtol=0.03, atol=0.0)
    if steps == 12:  # neighbours are the more alike, the redder it is
        power = 1 / np.arange(1, 7) ** colour  # of 1 to 6 turns in twelve steps; the constant part has that of one turn
        share = np.array([0.5 * power[0], *power[:5], 0.5 * power[5]])
        expected = (share * np.cos(2 * np.pi * np.arange(7) / 12)).sum() / share.sum()
        assert (noise[:, 3] * noise[:, 4]).mean().item() == pytest.approx(expected, abs=0.03)


# memory


def transformer(**options: Any) -> EnvironmentTransformer:
    """A real world model, with random weights, whose predictions depend on what it has seen."""
    torch.manual_seed(0)
    sizes = dict(layers=2, heads=2, width=16, context=4, random_features=8) | options
    model = EnvironmentTransformer(3, 1, **sizes).eval()
    for parameter in model.parameters():
        parameter.data *= 3
    return model.requires_grad_(False)


SMALL: dict[str, PlannerOptions] = {
    "random": RandomShootingOptions(horizon=3, samples=16),
    "cem": CEMOptions(horizon=3, samples=16, iterations=2, elites=4),
    "icem": ICEMOptions(horizon=3, samples=16, iterations=2, elites=4),
    "mppi": MPPIOptions(horizon=3, samples=16),
    "gradient": GradientOptions(horizon=3, samples=3, iterations=2),
}


def observations(count: int, rows: int = 3) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(rows, 3, generator=generator) for _ in range(count)]


def acts(planner: Any, seen: list[Tensor]) -> Tensor:
    return torch.stack([planner.act(observation) for observation in seen])


@pytest.mark.parametrize("name", PLANNERS)
def test_after_a_reset_a_planner_does_as_it_did_and_other_seeds_do_otherwise(name: str):
    make = lambda seed: PLANNERS[name](transformer(), *BOUNDS, SMALL[name], seed=seed)  # noqa: E731
    planner, seen = make(0), observations(6)
    first = acts(planner, seen)
    planner.reset()
    assert torch.equal(acts(planner, seen), first)
    assert not torch.equal(acts(make(1), seen), first)
    assert first.abs().max() <= 4 and isinstance(planner, StatefulPolicy)


@pytest.mark.parametrize("name", PLANNERS)
def test_rows_are_planned_as_if_they_were_alone(name: str):
    seen = observations(6)
    together = acts(PLANNERS[name](transformer(), *BOUNDS, SMALL[name]), seen)
    for row in range(3):
        alone = acts(PLANNERS[name](transformer(), *BOUNDS, SMALL[name]), [o[row : row + 1] for o in seen])
        torch.testing.assert_close(alone[:, 0], together[:, row], rtol=1e-3, atol=1e-3)


def test_the_model_has_seen_every_step_of_the_episode():
    """At each step the planner's candidates are judged after the episode's own history, as a causal pass reads it."""
    model, seen = transformer(), observations(7, rows=2)
    planner = MPPI(model, *BOUNDS, SMALL["mppi"])  # pyright: ignore[reportArgumentType]
    done: list[Tensor] = []
    for t, observation in enumerate(seen):
        found = planner.search(observation, torch.Generator().manual_seed(t))
        past = torch.stack(seen[: t + 1], 1), torch.stack([*done, torch.zeros(2, 1)], 1)[:, :-1]
        state = model.init(*past, torch.full((2,), t + 1))
        expected = planner.objective.returns(state, planner.scaled(found.candidates))
        torch.testing.assert_close(found.returns, expected, rtol=1e-3, atol=1e-3)
        done.append(planner.act(observation, generator=torch.Generator().manual_seed(t)))
    forgetful = model.init(seen[-1][:, None], torch.zeros(2, 0, 1), torch.ones(2, dtype=torch.long))
    assert not torch.allclose(
        planner.objective.returns(forgetful, planner.scaled(found.candidates)), expected, rtol=0.01
    )


@pytest.mark.parametrize("name", PLANNERS)
def test_a_plan_is_never_worse_than_the_priors(name: str):
    prior = TanhGaussianActor(3, 1, hidden=(8,), action_low=BOUNDS[0], action_high=BOUNDS[1])
    planner: Any = PLANNERS[name](transformer(), *BOUNDS, SMALL[name], prior=prior)
    observation = observations(1)[0]
    found = planner.search(observation)
    starts = planner._starts(3)
    torch.testing.assert_close(planner.scaled(starts[:, -1, 0]), prior.act(observation), rtol=1e-4, atol=1e-4)
    assert (found.returns.amax(1) >= planner.judge(starts, None).amax(1) - 1e-4).all()


def test_sampled_actions_are_as_wide_as_the_good_plans_lie():
    planner = MPPI(double_integrator(), *BOUNDS, MPPIOptions(horizon=3), reward=reward)
    deterministic = planner.act(BEGIN)
    planner.reset()
    sampled = planner.act(BEGIN, deterministic=False)
    assert not torch.equal(sampled, deterministic) and (sampled - deterministic).abs().max() < 4


def test_gradients_reach_the_plan_and_no_weight():
    model = transformer().requires_grad_(True)
    with torch.no_grad():
        acts(PLANNERS["gradient"](model, *BOUNDS, SMALL["gradient"]), observations(2))
    assert all(parameter.grad is None for parameter in model.parameters())


def test_evaluation_takes_a_planner_and_lets_it_begin_anew():
    robot = replace(ROBOTS["hopper"], max_episode_steps=3)
    torch.manual_seed(0)
    model = EnvironmentTransformer(11, 3, layers=1, heads=1, width=8, context=2, random_features=4).eval()
    planner = CEM(model.requires_grad_(False), [-1.0] * 3, [1.0] * 3, SMALL["cem"])  # pyright: ignore[reportArgumentType]
    first, second = (evaluate_policy(planner, robot, episodes=2, seed=0, progress=False) for _ in range(2))
    assert first.returns.tolist() == second.returns.tolist() and first.lengths.tolist() == [3, 3]
