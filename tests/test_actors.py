"""The kinds of actors: what they do, what they are on disk, and what starts from what."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envtf_lit.actors import POLICIES, Actor, DeterministicActor, GaussianActor, TanhGaussianActor
from envtf_lit.errors import UserError
from envtf_lit.policy import load_policy, save_policy

S, A, B = 3, 2, 6
LIMITS: dict[str, Any] = dict(action_low=[-2.0, 0.0], action_high=[2.0, 0.5])
KINDS = pytest.mark.parametrize("cls", list(POLICIES.values()))


def make_actor(cls: type[Actor], seed: int = 0, **limits: Any) -> Any:
    torch.manual_seed(seed)
    actor: Any = cls(S, A, hidden=(16, 16), **limits)
    actor.observation_mean.copy_(torch.randn(S))
    return actor


@KINDS
def test_every_kind_is_saved_with_its_name_and_acts_as_it_did(cls: type[Actor], tmp_path: Path) -> None:
    actor, observation = make_actor(cls, **LIMITS), torch.randn(B, S)
    save_policy(tmp_path / "policy", actor)
    again = load_policy(tmp_path / "policy")
    kind = json.loads((tmp_path / "policy/config.json").read_text())["kind"]
    assert POLICIES[kind] is cls is type(again)
    assert torch.equal(again.act(observation), actor.act(observation))


def test_a_folder_of_before_there_were_kinds_is_read_as_ever(tmp_path: Path) -> None:
    """It names `tanh_gaussian`, and arguments in that order."""
    actor = make_actor(TanhGaussianActor)
    save_policy(tmp_path / "policy", actor)
    config = tmp_path / "policy/config.json"
    arguments = dict(observation_dim=S, action_dim=A, hidden=[16, 16], layer_norm=False, log_std_min=-5.0)
    config.write_text(
        json.dumps({"kind": "tanh_gaussian", "arguments": {**arguments, "action_low": None, "action_high": None}})
    )
    assert torch.equal(load_policy(tmp_path / "policy").act(torch.ones(1, S)), actor.act(torch.ones(1, S)))


@pytest.mark.parametrize("name", ["log_std_min", "width"])
def test_arguments_that_a_kind_does_not_know_are_refused(name: str, tmp_path: Path) -> None:
    save_policy(tmp_path / "policy", make_actor(DeterministicActor))
    config = tmp_path / "policy/config.json"
    tree = json.loads(config.read_text())
    tree["arguments"][name] = 1.0
    config.write_text(json.dumps(tree))
    with pytest.raises(UserError, match="does not describe a deterministic"):
        load_policy(tmp_path / "policy")


@KINDS
def test_actions_stay_within_their_limits(cls: type[Actor]) -> None:
    actor, generator = make_actor(cls, **LIMITS), torch.Generator().manual_seed(0)
    with torch.no_grad():
        actor.net[-1].bias += 3.0
    drawn = actor.act(10 * torch.randn(500, S), deterministic=False, generator=generator)
    low, high = torch.tensor(LIMITS["action_low"]), torch.tensor(LIMITS["action_high"])
    assert (drawn >= low - 1e-6).all() and (drawn <= high + 1e-6).all()


@KINDS
def test_an_actor_starts_from_one_of_its_kind_alone(cls: type[Actor]) -> None:
    base, mine, observation = make_actor(cls, 0), make_actor(cls, 1), torch.randn(B, S)
    mine.start_from(base)
    torch.testing.assert_close(mine.act(observation), base.act(observation), rtol=1e-4, atol=1e-5)
    other = next(kind for kind in POLICIES.values() if kind is not cls)
    with pytest.raises(UserError, match="start from one like it"):
        mine.start_from(make_actor(other))


def test_the_gaussian_s_density_is_a_normal_one_around_a_squashed_mean() -> None:
    actor, observation = make_actor(GaussianActor), torch.randn(B, S)
    with torch.no_grad():
        actor.log_std.copy_(torch.tensor([-1.0, 0.5]))
    action = torch.rand(B, A) * 2 - 1
    expected = torch.distributions.Normal(actor.act(observation), torch.tensor([-1.0, 0.5]).exp())
    torch.testing.assert_close(actor.log_prob(observation, action), expected.log_prob(action).sum(-1))


def test_the_gaussian_s_density_at_the_limits_is_as_bounded_as_elsewhere() -> None:
    """A squashed Gaussian's grows without end there, and its clone term is swamped by it."""
    actor, observation = make_actor(GaussianActor), torch.zeros(1, S)
    at_limit = actor.log_prob(observation, torch.ones(1, A)).detach()
    assert -A * (0.5 * 4.0 + 0.5 * math.log(2 * math.pi)) < float(at_limit) < 0.0


def test_the_deterministic_actor_measures_distance_in_shares_of_its_range() -> None:
    actor, observation = make_actor(DeterministicActor, **LIMITS), torch.randn(B, S)
    off = actor.act(observation) + torch.tensor([0.2, 0.05])  # a tenth of half the range, and a fifth
    torch.testing.assert_close(actor.clone_error(observation, off), torch.full((B,), (0.1**2 + 0.2**2) / 2))


@KINDS
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_no_action_is_given_for_what_no_sensor_measures(cls: type[Actor], value: float, tmp_path: Path) -> None:
    """A saved policy acts on robots; in a world model's imagination it may be loaded without that look."""
    save_policy(tmp_path / "policy", make_actor(cls))
    observation = torch.zeros(B, S)
    actor = load_policy(tmp_path / "policy")
    assert actor.act(observation).isfinite().all()
    observation[4, 1] = value
    with pytest.raises(UserError, match=f"dimension 1 of the observation is {value}: .* stop the robot there"):
        actor.act(observation)
    with pytest.raises(UserError, match="dimension 1"):
        actor.act(observation[4:5], deterministic=False)
    unguarded = load_policy(tmp_path / "policy", guarded=False)
    assert not unguarded.act(torch.full((1, S), math.nan)).isfinite().any()
    graph = torch.export.export(actor, (observation,))  # which cannot raise
    assert "isfinite" not in str(graph.graph)


def test_least_squares_are_the_log_of_the_mean_action_s_error():
    torch.manual_seed(0)
    actor = TanhGaussianActor(3, 2, hidden=(8,), action_low=[-2.0, 0.0], action_high=[2.0, 1.0])
    observation = torch.randn(500, 3)
    halves = torch.tensor([2.0, 0.5])  # of the range
    missed = torch.tensor([0.1, 0.01])  # of those
    action = actor.act(observation) + halves * missed * torch.randn(500, 2).sign()
    error = actor.least_squares(observation, action)
    assert error.item() == pytest.approx(float(missed.log().mean()), abs=1e-3)
    gradient = torch.autograd.grad(error, list(actor.net.parameters()))
    assert all(bool(g.isfinite().all()) for g in gradient) and any(float(g.abs().sum()) > 0 for g in gradient)
    exact = actor.least_squares(observation, actor.act(observation))
    assert exact.item() == pytest.approx(math.log(1e-3), abs=1e-3)  # no finer than this is asked for


@KINDS
def test_what_is_given_comes_back_in_kind(cls: type[Actor]) -> None:
    """A tensor or an array, of either precision, one row or many."""
    actor = make_actor(cls, **LIMITS)
    rows = torch.randn(B, S)
    actions = actor.act(rows)
    assert actions.shape == (B, A) and actions.dtype == torch.float32 and not actions.requires_grad
    torch.testing.assert_close(actor.act(rows[0]), actions[0])
    torch.testing.assert_close(actor.act(rows.double()), actions.double())
    for given in (rows.numpy(), rows.double().numpy(), rows.tolist()):
        found = actor.act(given)
        assert isinstance(found, np.ndarray) and found.dtype == np.float32
        np.testing.assert_array_equal(found, actions.numpy())
        np.testing.assert_allclose(actor.act(given[0]), actions[0].numpy(), rtol=1e-5, atol=1e-6)
    drawn = [
        actor.act(x, deterministic=False, generator=torch.Generator().manual_seed(1)) for x in (rows, rows.numpy())
    ]
    np.testing.assert_array_equal(drawn[0].numpy(), drawn[1])


@KINDS
@pytest.mark.parametrize("shape", [(S + 1,), (B, S - 1), ()])
def test_observations_of_another_width_are_said(cls: type[Actor], shape: tuple[int, ...], tmp_path: Path) -> None:
    save_policy(tmp_path, make_actor(cls))
    policy = load_policy(tmp_path)
    for given in (np.zeros(shape), torch.zeros(shape)):
        with pytest.raises(UserError, match=rf"takes observations of {S} numbers: these have the shape \("):
            policy.act(given)
    with pytest.raises(UserError, match="dimension 1 of the observation is nan"):
        policy.act([0.0, math.nan, 0.0])
