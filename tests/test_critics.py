"""Critics beside the policy that they judge: what they say, in which units, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

import envtf_lit
from envtf_lit.actors import DeterministicActor, TanhGaussianActor
from envtf_lit.agents.actor_critic import ActorCritic
from envtf_lit.agents.bc import BC
from envtf_lit.agents.cql import CQL
from envtf_lit.agents.et_cql import ETCQL
from envtf_lit.agents.iql import IQL
from envtf_lit.agents.store import publish_policy
from envtf_lit.critics import Critics, load_critics, save_critics
from envtf_lit.errors import UserError
from envtf_lit.files import write_json
from envtf_lit.policy import load_policy, save_policy
from envtf_lit.training import Curves
from tests.hand_driven import SHORT, B, S, hand_driven, imagining, make_batch


def critics(**sizes: Any) -> Critics:
    torch.manual_seed(0)
    given: dict[str, Any] = dict(n=2, hidden=(8, 8), layer_norm=True, discount=0.9) | sizes
    made = Critics(S, 2, **given)
    made.stack.observation_mean.fill_(0.5)
    made.stack.observation_std.fill_(2.0)
    made.return_scale.fill_(30.0)
    return made


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """A folder of a policy with critics."""
    save_policy(tmp_path / "policy", TanhGaussianActor(S, 2, hidden=(8,), action_low=[-2.0] * 2, action_high=[2.0] * 2))
    save_critics(tmp_path / "policy", critics())
    return tmp_path / "policy"


def test_a_states_value_is_the_least_q_of_the_policys_action(policy: Path):
    found, made = envtf_lit.load_critics(policy), critics()
    observations, actions = torch.randn(5, S), torch.randn(5, 4, 2)
    q = 30.0 * made.stack(observations, actions)
    torch.testing.assert_close(found.critics(observations, actions), q)
    torch.testing.assert_close(found.q(observations, actions), torch.minimum(q[0], q[1]))
    assert found.q(observations, actions[:, 0]).shape == (5,)
    chosen = load_policy(policy).act(observations)
    torch.testing.assert_close(found.value(observations), found.q(observations, chosen))
    assert found.critics.discount == 0.9 and not found.value(observations).requires_grad


def test_a_gradient_reaches_states_and_no_weight(policy: Path):
    found, observations = load_critics(policy), torch.randn(5, S, requires_grad=True)
    found.value(observations).sum().backward()
    assert observations.grad is not None and observations.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in found.critics.parameters())


@pytest.mark.parametrize("cls", [CQL, IQL, ETCQL])
def test_what_an_agent_publishes_is_in_units_of_the_logs_rewards(cls: type[ActorCritic]):
    make = imagining if cls.imagines else hand_driven
    further: dict[str, Any] = {"value_gradient": SHORT} if cls is ETCQL else {}
    agent, batch = make(cls, discount=0.95, layer_norm=True, **further), make_batch()
    agent.critics.observation_mean.fill_(0.25)
    if cls is ETCQL:
        agent.frontier.critics[0].load_state_dict(agent.critics.state_dict())  # the clone's, that is kept
    agent.return_scale.fill_(7.0)
    expected = 7.0 * agent.critics(batch["observations"], batch["actions"])
    torch.manual_seed(5)
    published = agent.published_critics()
    drawn = torch.randn(2)
    torch.testing.assert_close(published(batch["observations"], batch["actions"]), expected)
    assert published.discount == 0.95 and expected.shape == (2, B)
    torch.manual_seed(5)
    assert torch.equal(drawn, torch.randn(2))  # whoever publishes, keeps its own draws


def publish(folder: Path, agent: Any) -> None:
    publish_policy(folder, agent.average_actor, Curves(), {}, {}, critics=agent.published_critics())


def test_a_published_folder_has_critics_where_its_algorithm_has(tmp_path: Path):
    publish(tmp_path / "cql", hand_driven(CQL))
    assert {path.name for path in (tmp_path / "cql/critics").iterdir()} == {"config.json", "weights.safetensors"}
    assert load_critics(tmp_path / "cql").value(torch.zeros(4, S)).shape == (4,)
    publish(tmp_path / "bc", hand_driven(BC))
    assert not (tmp_path / "bc/critics").exists()
    assert load_policy(tmp_path / "bc").act(torch.zeros(4, S)).shape == (4, 1)
    publish(tmp_path / "cql", hand_driven(BC))  # another training's critics do not stay
    with pytest.raises(UserError, match="cql has no critics: its algorithm learns none, or an earlier version"):
        load_critics(tmp_path / "cql")


# what is refused


def changed(folder: Path, **values: object) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["arguments"].update(values)
    write_json(folder / "config.json", config)


def scaled(folder: Path, value: float) -> None:
    tensors = load_file(folder / "weights.safetensors")
    tensors["return_scale"].fill_(value)
    save_file(tensors, folder / "weights.safetensors")


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "pickle": (lambda f: torch.save({}, f / "weights.safetensors"), "is not a safetensors file"),
    "foreign kind": (lambda f: write_json(f / "config.json", {"kind": "os.system"}), "unknown kind 'os.system'"),
    "a policy": (lambda f: save_policy(f, DeterministicActor(S, 2)), "unknown kind 'deterministic'"),
    "no layers": (lambda f: changed(f, hidden=[]), "does not describe a critics"),
    "no members": (lambda f: changed(f, n=0), "does not describe a critics"),
    "no discount": (lambda f: changed(f, discount=0.0), "does not describe a critics"),
    "a discount above one": (lambda f: changed(f, discount=1.5), "does not describe a critics"),
    "text": (lambda f: changed(f, discount="x"), "does not describe a critics"),
    "absurd": (lambda f: changed(f, observation_dim=10**9), r"stack\.from_observation\.weight has shape"),
    "no scale": (lambda f: scaled(f, 0.0), r"return_scale is 0\.0"),
    "an endless scale": (lambda f: scaled(f, torch.inf), "return_scale is inf"),
    "no number": (lambda f: scaled(f, torch.nan), "holds nan in return_scale"),
    "another robot's": (
        lambda f: save_critics(f.parent, Critics(7, 2, n=1, hidden=(4,), layer_norm=False, discount=0.9)),
        r"observations of size 7 and actions of size 2, and the policy has 3 and 2",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_critics_are_refused_and_the_policy_still_acts(policy: Path, damage: str):
    break_it, sentence = DAMAGE[damage]
    break_it(policy / "critics")
    with pytest.raises(UserError, match=sentence) as caught:
        load_critics(policy)
    assert "critics" in str(caught.value)
    assert load_policy(policy).act(torch.zeros(1, S)).shape == (1, 2)
