"""A planner in the simulator: its returns, and how many decisions it makes in a second."""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from envtf_lit.critics import CRITICS, PolicyCritics, load_critics
from envtf_lit.devices import autocast
from envtf_lit.errors import UserError
from envtf_lit.imagination.dream import Dream, DreamOptions
from envtf_lit.options.schema import Precision, build
from envtf_lit.planning.planner import Planner
from envtf_lit.planning.registry import PLANNERS
from envtf_lit.policy import Policy, load_policy
from envtf_lit.registration import ENV_ID
from envtf_lit.robots.environments import action_limits, robot_in
from envtf_lit.robots.returns import Returns, evaluate_policy
from envtf_lit.robots.tasks import ROBOTS, Robot
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.store import load_world_model
from envtf_lit.world_models.termination_head import termination_rule


@dataclass(frozen=True, eq=False)
class PlannedReturns:
    """What a planner reached.

    Attributes:
        planned: its episodes.
        decisions_per_second: for one episode alone, if there was one; else for all of them together.
        prior: the prior's own episodes from the same seeds; None without one.
        discount: of the planner, per step.
        valued: whether the prior's critics judged what follows a plan.
    """

    planned: Returns
    decisions_per_second: float
    prior: Returns | None
    discount: float
    valued: bool


class Timed:
    """A planner, and the seconds that its decisions take.

    Attributes:
        seconds, decisions: so far.
    """

    def __init__(self, planner: Planner[Any]) -> None:
        self.planner, self.seconds, self.decisions = planner, 0.0, 0

    def reset(self) -> None:
        """See `Planner.reset`."""
        self.planner.reset()

    def act(self, observation: Tensor, deterministic: bool = True, generator: torch.Generator | None = None) -> Tensor:
        """See `Planner.act`."""
        begin = time.perf_counter()
        action = self.planner.act(observation, deterministic, generator)
        self.seconds += time.perf_counter() - begin
        self.decisions += len(observation)
        return action


def robot_to_plan_for(
    world_model: Path, task: str | None, dataset: Path | None = None, *, steps: int | None = None
) -> Robot:
    """A robot with an environment to play in: its simulator, or, without a task, the world model that is planned in.

    Episodes in the model begin where the log's do, and end where a robot falls, by its rule or by the one learned from
    the log, or where the model no longer knows.

    Args:
        world_model: folder.
        task: of ours, or the id of a Gymnasium environment, of which no rule is known but what the model learned.
        dataset: log; needed without a task.
        steps: of an episode in the model at most; None: of the log's longest.

    Raises:
        UserError: there is no such environment, or as of `Dream`.
    """
    if task is not None:
        robot = robot_in(task)
        return robot if robot.name in ROBOTS else replace(robot, terminated=_learned_rule(world_model))
    dream = Dream(world_model, dataset, options=DreamOptions(starts="episodes"))
    if dream.dataset is None:
        raise UserError("Without a task a planner plays in the world model, from states of its log: give the dataset.")
    longest = int(dream.dataset.episode_lengths.max()) if steps is None else steps
    return Robot(
        "the log's robot",
        ENV_ID,
        dream.model.observation_dim,
        dream.model.action_dim,
        return_random=float("nan"),
        return_expert=float("nan"),
        terminated=dream.terminated,
        env_kwargs=dict(world_model=world_model, dataset=dream.dataset, starts="episodes", max_steps=longest),
        max_episode_steps=longest,
    )


def _learned_rule(world_model: Path) -> Callable[[Tensor], Tensor]:
    return termination_rule(None, world_model, torch.device("cpu"))


def planner_of(
    name: str,
    model: WorldModel,
    robot: Robot,
    words: Sequence[str] = (),
    *,
    prior: Policy | None = None,
    critics: PolicyCritics | None = None,
    seed: int = 0,
) -> Planner[Any]:
    """The planner of that name for a robot.

    Args:
        name: of `PLANNERS`.
        model: any world model.
        robot: whose rule ends plans, and whose action range is searched.
        words: its options that are not the default, such as `horizon=20`.
        prior: see `Planner`.
        critics: whose value ends plans; their discount is the planner's, unless `words` say otherwise.
        seed: of everything random.

    Raises:
        UserError: an unknown option, one out of range, or a model of another robot.
    """
    if (model.observation_dim, model.action_dim) != (robot.observation_dim, robot.action_dim):
        raise UserError(
            f"The world model has observations of size {model.observation_dim} and actions of size {model.action_dim}, "
            f"and {robot.name}{robot.variant} has {robot.observation_dim} and {robot.action_dim}: take a model that "
            "was trained on this robot."
        )
    cls, (low, high) = PLANNERS[name], action_limits(robot)
    common = {} if critics is None else {"discount": critics.critics.discount}
    options = build(cls.Options, common | dict(_assignment(word) for word in words), "")
    value = None if critics is None else critics.value
    further = dict(terminated=robot.terminated, value=value, prior=prior, seed=seed)
    return cls(model, low.tolist(), high.tolist(), options, **further)  # pyright: ignore[reportArgumentType]


def _assignment(word: str) -> tuple[str, Any]:
    """NAME=VALUE, the value a number, true, false or null, else text."""
    name, equals, text = word.partition("=")
    if not (name and equals):
        raise UserError(f"--option {word!r} has no name and value: write --option horizon=20.")
    try:
        return name, json.loads(text)
    except ValueError:
        return name, text


def score_planner(
    world_model: Path,
    robot: Robot,
    planner: str,
    words: Sequence[str] = (),
    *,
    policy: Path | None = None,
    critics: bool = True,
    episodes: int,
    steps: int | None = None,
    seed: int,
    precision: Precision = "fp32",
    progress: bool = True,
) -> PlannedReturns:
    """Plays a planner in a robot's environment, and beside it the policy that it starts from.

    Args:
        world_model: folder.
        robot: as of `robot_to_plan_for`.
        planner, words: as of `planner_of`.
        policy: folder of the prior; None plans without one.
        critics: the prior's value of a plan's last state counts, where the folder has critics.
        episodes: of each.
        steps: of an episode at most; None: as many as the robot's episodes have.
        seed: of the episodes and the planner.
        precision: of matrix products while it plans.
        progress: shows a bar.

    Raises:
        UserError: as of `planner_of`, or a folder that holds no world model or no policy of this robot.
    """
    model = load_world_model(world_model)
    prior = None if policy is None else load_policy(policy, guarded=False)  # it acts in imagined states, too
    if prior is not None and len(prior.observation_mean) != robot.observation_dim:
        raise UserError(
            f"{policy} holds a policy of observations of size {len(prior.observation_mean)}, and {robot.name} has "
            f"{robot.observation_dim}: take one that was trained on this robot."
        )
    judging = load_critics(policy) if critics and policy is not None and (policy / CRITICS).is_dir() else None
    timed = Timed(planner_of(planner, model, robot, words, prior=prior, critics=judging, seed=seed))
    body = robot if steps is None else replace(robot, max_episode_steps=steps)
    with autocast(torch.device("cpu"), precision):
        found = evaluate_policy(timed, body, episodes=episodes, seed=seed, progress=progress)
    beside = None
    if prior is not None:
        beside = evaluate_policy(prior, body, episodes=episodes, seed=seed, progress=progress)
    rate, discount = timed.decisions / timed.seconds, timed.planner.options.discount
    return PlannedReturns(found, rate, beside, discount, judging is not None)
