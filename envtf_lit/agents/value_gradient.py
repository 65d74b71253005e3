"""Policy improvement by the gradient of imagined returns, which runs through the world model step by step."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from envtf_lit.actors import TanhGaussianActor
from envtf_lit.agents.actor_critic import held_fixed
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.networks import StateValue
from envtf_lit.agents.phases import Batch, Logs, Phase, follow
from envtf_lit.imagination.buffer import Imagination
from envtf_lit.imagination.histories import Histories
from envtf_lit.imagination.rollouts import Rollouts, gather_steps
from envtf_lit.options.numbers import Count, NonNegative, NonzeroShare, Positive
from envtf_lit.options.schema import rare
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.unroll import Step, lost, unroll

HIDDEN = (256, 256)  # units of the state value
LEARNING_RATE = 0.001  # of the state value
BATCH = 256  # states per gradient step of the state value
PASSES = 4  # of the state value over the steps of each update
TRACE = 0.95  # lambda of the state value's TD(lambda) targets
TARGET_RATE = 0.3  # share of the state value that enters its target at each update of the actor
OLDEST = 1_000  # steps after which a rollout begins anew at a real state
BETAS = (0.7, 0.95)  # of the actor's Adam, as in SHAC
LOST = 0.1  # what an e-fold of novelty beyond the limit costs a path that ends there, in deviations of the returns
CLIP = 1.0  # largest norm of the actor's gradient


@dataclass(frozen=True)
class ValueGradientOptions:
    """The last updates of a policy that imagines: its actor follows the gradient of imagined returns (SHAC, Xu 2022).

    Attributes:
        updates: of all the policy's updates, the last so many; each is one of the actor.
        rollouts: imagined at a time; each is carried on from update to update until the robot falls.
        horizon: steps of each rollout per update, after which a learned state value stands for what follows; fewer
            where the model's held-out reach (`world_models.fit`) is shorter.
        learning_rate: Adam's, of the actor; reached after a tenth of these updates, from there linearly to zero.
        clone_weight: weight in the actor's objective of cloning the real rows' actions, mean over action dimensions.
        actor_average: share of the actor that enters the averaged actor at each of these updates.
    """

    updates: Count = 400
    rollouts: Count = 64
    horizon: Count = 16
    learning_rate: Positive = 0.001
    clone_weight: NonNegative = 0.15
    actor_average: NonzeroShare = rare(0.05)


@dataclass(frozen=True)
class Paths(Rollouts):
    """Rollouts under way, of which none has left; differentiable.

    Attributes:
        excess: (H, B) `log(novelty / novelty_limit)`, zero where the model knows its way.
    """

    excess: Tensor


class StateValues(nn.Module):
    """`V(s)` and its slow target, which stand for what follows an imagined path.

    Args:
        observation_dim: S.
    """

    def __init__(self, observation_dim: int) -> None:
        super().__init__()
        self.value = StateValue(observation_dim, hidden=HIDDEN)
        self.target_value = copy.deepcopy(self.value).requires_grad_(False)

    def imagined_return(self, paths: Paths, discount: float, spread: float | Tensor) -> Tensor:
        """(B,) `sum_k discount^k r_k + discount^H V(s_H)`, up to the fall (Xu et al. 2022, equation 5).

        Where the model has left what it knows, at a step k, its prediction counts for nothing: the path ends in s_k,
        the last state that it knew, at what that is `worth`.
        """
        stands, taken = standing(paths)
        powers = discount ** torch.arange(len(stands), device=stands.device)[:, None]
        total = torch.where(taken, powers[:-1] * paths.rewards, 0.0).sum(0)
        states = torch.cat([paths.observations, paths.next_observations[-1:]])
        cut = (stands[:-1] & paths.halted).any(0)
        last = torch.where(cut, stands.sum(0) - 1, len(taken))  # (B,) the state that each path ends in
        end = self.value(states[last, torch.arange(len(last), device=last.device)])
        excess = torch.where(stands[:-1] & paths.halted, paths.excess, 0.0).sum(0)
        end = torch.where(cut, worth(end, excess, spread), end)
        return total + torch.where(cut | stands[-1], discount**last * end, 0.0)

    @torch.no_grad()
    def value_targets(self, paths: Paths, discount: float, spread: float | Tensor) -> Tensor:
        """(H, B) TD(lambda) targets under the slow state value (Xu et al. 2022, equations 6, 7), to a fall or a cut."""
        later = self.target_value(paths.next_observations)
        cut = worth(self.target_value(paths.observations), paths.excess, spread)
        target, targets = later[-1], torch.empty_like(paths.rewards)
        for t in reversed(range(len(targets))):
            target = (1.0 - TRACE) * later[t] + TRACE * target
            target = paths.rewards[t] + torch.where(paths.terminated[t], 0.0, discount * target)
            target = targets[t] = torch.where(paths.halted[t], cut[t], target)
        return targets

    def value_batches(
        self, paths: Paths, discount: float, spread: float | Tensor, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches of visited states and their targets, several times in random order."""
        visited = standing(paths)[0][:-1].flatten()
        states = paths.observations.detach().flatten(0, 1)[visited]
        targets = self.value_targets(paths, discount, spread).flatten()[visited]
        for _ in range(PASSES):
            order = torch.randperm(len(states), generator=generator, device=states.device)
            for rows in order.split(BATCH):
                yield states[rows], targets[rows]

    def value_loss(self, observations: Tensor, returns: Tensor) -> Tensor:
        """`(V(s) - G)^2`, mean over the batch."""
        return (self.value(observations) - returns).square().mean()


def standing(paths: Paths) -> tuple[Tensor, Tensor]:
    """Which states and transitions of paths mean anything.

    Returns:
        (H + 1, B) bool, states that a path stands in, neither fallen nor lost before; the last row is what outlives the
        path. (H, B) bool, transitions from there that the model knew enough to predict.
    """
    goes_on = (~(paths.terminated | paths.halted)).cumprod(0).bool()
    stands = torch.cat([torch.ones_like(goes_on[:1]), goes_on])
    return stands, stands[:-1] & ~paths.halted


def worth(value: Tensor, excess: Tensor, spread: float | Tensor) -> Tensor:
    """What a path is worth that the model can't follow further: `V(s) - LOST std(G) log(novelty / limit)`.

    `V(s)` of the last state that it knew, since what lies behind may hold riches or ruin, and here is no evidence of
    either. A bare end would have no gradient in the action that led astray; so it costs a little more the further it
    led. At ten times the cost that gradient rules all others, and the policy stays where it began: on
    hopper-medium-replay (seed 0) `et_cql` then scored 45 and 60, at this cost 84, with a bare end 84, unguarded 91.
    """
    return value - LOST * spread * excess


class ImaginedPaths:
    """Rollouts under way, carried on `horizon` steps at a time, so that the actor meets the states it leads to itself.

    Args:
        imagination: the world model and where rollouts begin.
        options: number of rollouts and their horizon.
    """

    def __init__(self, imagination: Imagination, options: ValueGradientOptions) -> None:
        self.imagination, self.options = imagination, options
        self.histories: Histories | None = None
        self.former: Any = None  # the model's state that the paths before began in, whose worlds go on

    def next(self, actor: TanhGaussianActor, scale: Tensor, generator: torch.Generator) -> Paths:
        """The next `horizon` steps under the actor's sampled actions, differentiable in the actor.

        Each rollout runs, from its real state to its end, in a world model of its own, drawn from the posterior as the
        rollouts' options say. They also say what uncertainty costs, and where a path has left what the model knows. No
        rollout leaves where its robot falls, or where it is lost: what comes after means nothing.

        Args:
            actor: acts.
            scale: by which rewards are divided.
            generator: of starts, worlds, actions and next states.
        """
        model, o = self.imagination.model, self.imagination.options
        if self.histories is None:
            self.histories = self.imagination.starts.draw(self.options.rollouts, o.history, generator)
            self.age = torch.zeros_like(self.histories.lengths)
            self.former = None
        with torch.no_grad():
            state = self.histories.begin(model, posterior=o.posterior, generator=generator)
            if self.former is not None:
                state = model.same_worlds(state, self.former, self.age > 0)
            self.former = state

        def act(t: int, rows: Tensor, observation: Tensor) -> Tensor:
            return actor.sample(observation, generator=generator)[0]

        steps = [*unroll(model, state, act, self.options.horizon, mode=o.mode, generator=generator)]
        paths = gather_steps(map(self._with_ends, steps), self.options.rollouts)
        self._carry_on(paths, generator)
        excess = torch.stack([self._excess(step.prediction) for step in steps])
        return Paths(**vars(paths) | {"rewards": self.imagination.charged(paths) / scale, "excess": excess})

    def _with_ends(self, step: Step) -> tuple[Step, Tensor, Tensor]:
        fell = self.imagination.terminated(step.prediction.observation)
        return step, fell, ~fell & lost(step.prediction, self.imagination.options.novelty_limit)

    def _excess(self, prediction: Prediction) -> Tensor:
        limit, novelty = self.imagination.options.novelty_limit, prediction.novelty
        if limit is None or novelty is None:
            return torch.zeros_like(prediction.reward)
        return (novelty / limit).clamp(min=1.0).log()

    @torch.no_grad()
    def _carry_on(self, paths: Rollouts, generator: torch.Generator) -> None:
        """Where the next paths begin: at the ends of these, but at real states where they ended or grew old."""
        history, horizon = self.imagination.options.history, self.options.horizon
        observations = torch.cat([paths.observations[horizon - history :], paths.next_observations[-1:]])
        actions = paths.actions[horizon - history :]
        fresh = self.imagination.starts.draw(self.options.rollouts, history, generator)
        self.age += horizon
        ended = (paths.terminated | paths.halted).any(0) | (self.age >= OLDEST)  # (B,)
        self.age[ended] = 0
        self.histories = Histories(
            torch.where(ended[:, None, None], fresh.observations, observations.transpose(0, 1)),
            torch.where(ended[:, None, None], fresh.actions, actions.transpose(0, 1)),
            torch.where(ended, fresh.lengths, torch.full_like(fresh.lengths, history + 1)),
        )


class ValueGradient(Phase):
    """The actor follows the gradient of imagined returns, kept near the real rows' actions (SVG, Heess et al. 2015).

    A state value, learned on those very paths, stands for what follows a path (SHAC, Xu et al. 2022). The agent's
    parts are `actor_by_gradient` and `value`.

    Args:
        imagination: the world model and where rollouts begin.
        values: the state value.
        options: of the paths and of the optimisation.
    """

    def __init__(self, imagination: Imagination, values: StateValues, options: ValueGradientOptions) -> None:
        self.options, self.updates, self.values = options, options.updates, values
        self.paths = ImaginedPaths(imagination, options)

    def begin_epoch(self, agent: Agent) -> None:
        """Forgets the rollouts under way; the next path begins at real states."""
        self.paths.histories = None

    def update(self, agent: Agent, batch: Batch, done: int) -> Logs:
        """One update of the actor, beginning at the averaged one; the state value then learns from the same paths."""
        if done == 0:
            agent.actor.load_state_dict(agent.average_actor.state_dict())
        with torch.autocast(agent.device.type, enabled=False):  # errors of bf16 would add up along the path
            logs = self.value_gradient_step(agent, batch, done)
        follow(self.values.target_value, self.values.value, TARGET_RATE)
        follow(agent.average_actor, agent.actor, self.options.actor_average)
        return logs

    def value_gradient_step(self, agent: Agent, batch: Batch, done: int) -> Logs:
        """One step of the actor along the gradient, and several of the state value."""
        values, discount = self.values, agent.options.discount
        spread = agent.log_returns.spread / agent.return_scale
        assert isinstance(agent.actor, TanhGaussianActor)
        paths = self.paths.next(agent.actor, agent.return_scale, agent.generator)
        with held_fixed(values.value):
            imagined = values.imagined_return(paths, discount, spread).mean()
            clone_loss = agent.clone_loss(batch)
            loss = self.options.clone_weight * clone_loss - imagined
            agent.descend("actor_by_gradient", loss, rate=self.rate(done / self.updates), clip=CLIP)
        value_loss = torch.zeros(())
        for observations, targets in values.value_batches(paths, discount, spread, agent.generator):
            value_loss = values.value_loss(observations, targets)
            agent.descend("value", value_loss)
        cut = (standing(paths)[0][:-1] & paths.halted).any(0).float().mean()
        logs = dict(imagined_value=imagined * agent.return_scale, value_loss=value_loss, clone_loss=clone_loss)
        return logs | {"cut_share": cut}

    def rate(self, progress: float) -> float:
        """The actor's learning rate after this share of the updates: up over the first tenth, then down to zero."""
        return self.options.learning_rate * min(10.0 * progress, (1.0 - progress) / 0.9)
