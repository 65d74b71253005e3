"""Policy improvement by the gradient of imagined returns, which runs through the world model step by step."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from envtf_lit.actors import Actor, TanhGaussianActor
from envtf_lit.agents.actor_critic import held_fixed
from envtf_lit.agents.agent import Agent
from envtf_lit.agents.phases import Batch, Logs, Phase, follow
from envtf_lit.agents.trust_levels import Level
from envtf_lit.imagination.buffer import Imagination
from envtf_lit.imagination.histories import Histories
from envtf_lit.imagination.promise import promised
from envtf_lit.imagination.rollouts import Rollouts, gather_steps
from envtf_lit.options.numbers import Count, NonzeroShare, Positive
from envtf_lit.options.schema import rare
from envtf_lit.world_models.unroll import Step, lost, unroll

if TYPE_CHECKING:
    from envtf_lit.agents.et_cql import ETCQL

CRITIC_STEPS = 8  # of the critics, for each of the actor
CRITIC_RATE = 0.001  # Adam's, of the critics here
REAL_ROWS = 0.25  # share of the real ones in each of the critics' batches
TRACE = 0.95  # lambda of the critics' TD(lambda) targets
TARGET_RATE = 0.3  # share of the critics that enters the target critics at each update of the actor
FIRSTS = 0.25  # share of the real states that rollouts begin at which are the first of an episode
OLDEST = 1_000  # steps after which a rollout begins anew at a real state, where the log knows no time limit
BETAS = (0.7, 0.95)  # of the actor's Adam, as in SHAC
CLIP = 1.0  # largest norm of the actor's gradient
PLACES = 4  # actors on the way that a promise is asked of
EPISODES = 48  # imagined, for each promise


@dataclass(frozen=True)
class ValueGradientOptions:
    """The last updates of a policy that imagines: its actor follows the gradient of imagined returns (SHAC, Xu 2022).

    Attributes:
        updates: of all the policy's updates, the last so many; each is one of the actor.
        rollouts: imagined at a time; each is carried on from update to update until the robot falls.
        horizon: steps of each rollout per update, after which the conservative Q stands for what follows; fewer where
            the model's held-out reach (`world_models.fit`) is shorter.
        learning_rate: Adam's, of the actor; reached after a tenth of these updates, in the last tenth down to zero.
        actor_average: share of the actor that enters the averaged actor at each of these updates.
    """

    updates: Count = 400
    rollouts: Count = 64
    horizon: Count = 16
    learning_rate: Positive = 0.001
    actor_average: NonzeroShare = rare(0.05)


def standing(paths: Rollouts) -> tuple[Tensor, Tensor]:
    """Which states and transitions of paths mean anything.

    Returns:
        (H + 1, B) bool, states that a path stands in, neither fallen nor lost before; the last row is what outlives the
        path. (H, B) bool, transitions from there that the model knew enough to predict.
    """
    goes_on = (~(paths.terminated | paths.halted)).cumprod(0).bool()
    stands = torch.cat([torch.ones_like(goes_on[:1]), goes_on])
    return stands, stands[:-1] & ~paths.halted


def imagined_return(paths: Rollouts, end: Tensor, low: float | Tensor, discount: float) -> Tensor:
    """(B,) `sum_k discount^k r_k + discount^H Q(s_H, a_H)`, up to the fall (Xu et al. 2022, equation 5).

    Where the model has left what it knows, at a step k, its prediction counts for nothing: the path ends in s_k, at
    what only the worst of the log falls short of, since what lies behind may hold riches or ruin.

    Args:
        paths: H steps of B rollouts, of which none has left.
        end: (B,) values of the last states.
        low: value of being lost.
        discount: per step.
    """
    stands, taken = standing(paths)
    powers = discount ** torch.arange(len(stands), device=stands.device)[:, None]
    total = torch.where(taken, powers[:-1] * paths.rewards, 0.0).sum(0)
    astray = torch.where(stands[:-1] & paths.halted, powers[:-1] * low, 0.0).sum(0)
    return total + astray + torch.where(stands[-1], powers[-1] * end, 0.0)


@torch.no_grad()
def lambda_targets(paths: Rollouts, later: Tensor, low: float | Tensor, discount: float) -> Tensor:
    """(H, B) TD(lambda) targets (Xu et al. 2022, equations 6, 7) under values (H, B) of next states; `low` if lost."""
    target, targets = later[-1], torch.empty_like(paths.rewards)
    for t in reversed(range(len(targets))):
        target = (1.0 - TRACE) * later[t] + TRACE * target
        target = paths.rewards[t] + torch.where(paths.terminated[t], 0.0, discount * target)
        target = targets[t] = torch.where(paths.halted[t], low, target)
    return targets


class ImaginedPaths:
    """Rollouts under way, carried on `horizon` steps at a time, so that the actor meets the states it leads to itself.

    Args:
        imagination: the world model and where rollouts begin.
        options: number of rollouts and their horizon.
        believes: rewards above any recorded one; else a path is lost where the model promises one.
    """

    def __init__(self, imagination: Imagination, options: ValueGradientOptions, *, believes: bool = True) -> None:
        self.imagination, self.options = imagination, options
        self.believes = believes
        self.histories: Histories | None = None
        self.former: Any = None  # the model's state that the paths before began in, whose worlds go on

    def next(self, actor: TanhGaussianActor, scale: Tensor, generator: torch.Generator) -> Rollouts:
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
            self.histories = self._fresh(generator)
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
        return replace(paths, rewards=self.imagination.charged(paths) / scale)

    def _with_ends(self, step: Step) -> tuple[Step, Tensor, Tensor]:
        fell = self.imagination.terminated(step.prediction.observation)
        astray = lost(step.prediction, self.imagination.options.novelty_limit)
        if not self.believes:
            astray = astray | self.imagination.overpaid(step.prediction)
        return step, fell, ~fell & astray

    def _fresh(self, generator: torch.Generator) -> Histories:
        """Real states to begin at, many of them first ones: a log has one in each episode, and so has a robot."""
        o = self.imagination.options
        return self.imagination.starts.draw_with_firsts(self.options.rollouts, o.history, FIRSTS, generator)

    @torch.no_grad()
    def _carry_on(self, paths: Rollouts, generator: torch.Generator) -> None:
        """Where the next paths begin: at the ends of these, but at real states where they ended or grew old."""
        history, horizon = self.imagination.options.history, self.options.horizon
        observations = torch.cat([paths.observations[horizon - history :], paths.next_observations[-1:]])
        actions = paths.actions[horizon - history :]
        fresh = self._fresh(generator)
        self.age += horizon
        ended = (paths.terminated | paths.halted).any(0) | (self.age >= self.imagination.longest(OLDEST))  # (B,)
        self.age[ended] = 0
        self.histories = Histories(
            torch.where(ended[:, None, None], fresh.observations, observations.transpose(0, 1)),
            torch.where(ended[:, None, None], fresh.actions, actions.transpose(0, 1)),
            torch.where(ended, fresh.lengths, torch.full_like(fresh.lengths, history + 1)),
        )


class ValueGradient(Phase):
    """The actor follows the gradient of imagined returns that end in the conservative Q, as far as trust reaches.

    Trust grows from none to the level's slack over the phase. At some places on the way the world model is asked what
    it promises of the averaged actor; the last update keeps the one that is worth leaving the log for
    (`Frontier.choose`). The gradient is SVG's (Heess et al. 2015); critics learn on those very paths (SHAC, Xu et al.
    2022) and on real rows, with the conservative term of the agent's own `critic_loss`.

    Args:
        imagination: the world model and where rollouts begin.
        options: of the paths and of the optimisation.
        level: of trust.
    """

    def __init__(self, imagination: Imagination, options: ValueGradientOptions, level: Level) -> None:
        self.options, self.updates, self.level = options, options.updates, level
        self.paths = ImaginedPaths(imagination, options, believes=level.believes)
        self.asked = {round(options.updates * (k + 1) / PLACES) - 1 for k in range(PLACES)}  # updates

    def begin_epoch(self, agent: Agent) -> None:
        """Forgets the rollouts under way; the next path begins at real states."""
        self.paths.histories = None

    def update(self, agent: "ETCQL", batch: Batch, done: int) -> Logs:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One update of the actor; the critics then learn from the same paths, beside the batch's real rows."""
        with torch.autocast(agent.device.type, enabled=False):  # errors of bf16 would add up along the path
            if done == 0:
                agent.actor.load_state_dict(agent.average_actor.state_dict())
                if not agent.trust.best.isfinite():  # no warm start: what it begins with stands for the clone
                    agent.trust.look(agent.average_actor)
                self.ask(agent, agent.average_actor, 0)
            paths = self.paths.next(agent.actor, agent.return_scale, agent.generator)
            logs = self.actor_step(agent, paths, batch, done) | self.critic_steps(agent, paths, batch)
            follow(agent.target_critics, agent.critics, TARGET_RATE)
            follow(agent.average_actor, agent.actor, self.options.actor_average)
            if done in self.asked:
                self.ask(agent, agent.average_actor, done + 1)
        if done == self.updates - 1:
            agent.average_actor.load_state_dict(agent.frontier.choose(self.level.price).state_dict())
        return logs

    def actor_step(self, agent: "ETCQL", paths: Rollouts, batch: Batch, done: int) -> Logs:
        """`-E[imagined return] - weight E[log pi(a|s)]`, the weight being the trust constraint's dual variable."""
        progress, low = done / self.updates, agent.log_returns.low / agent.return_scale
        weight = agent.trust.ascend(agent.actor, self.level.slack * (done + 1) / self.updates, agent.generator)
        with held_fixed(agent.critics):
            last = paths.next_observations[-1]
            end = agent.critics(last, agent.actor.sample(last, generator=agent.generator)[0]).min(0).values
            imagined = imagined_return(paths, end, low, agent.options.discount).mean()
            clone_loss = agent.clone_loss(agent.complete_returns(batch))
            loss = weight * agent.action_dim * clone_loss - imagined
            agent.descend("actor_by_gradient", loss, rate=self.rate(progress), clip=CLIP)
        cut = (standing(paths)[0][:-1] & paths.halted).any(0).float().mean()
        logs = dict(imagined_value=imagined * agent.return_scale, clone_loss=clone_loss, trust_weight=weight)
        return logs | {"cut_share": cut}

    def critic_steps(self, agent: "ETCQL", paths: Rollouts, batch: Batch) -> Logs:
        """Some steps of the critics on the paths' states, whose targets look to the paths' ends, and on real rows."""
        logs: Logs = {}
        imagined = self.rows(agent, paths)
        size = len(batch["real"])
        real = max(1, round(REAL_ROWS * size))
        for _ in range(CRITIC_STEPS):
            drawn = torch.randint(size, (real,), generator=agent.generator, device=agent.device)
            count = len(imagined["real"])
            taken = torch.randint(count, (size - real,), generator=agent.generator, device=agent.device)
            mixed = {name: torch.cat([batch[name][drawn], column[taken]]) for name, column in imagined.items()}
            loss, logs = agent.critic_loss(mixed)
            agent.descend("critics", loss, rate=CRITIC_RATE)
        return logs

    @torch.no_grad()
    def rows(self, agent: "ETCQL", paths: Rollouts) -> Batch:
        """Columns (N, …) of the transitions that paths stand at: their targets as rewards, nothing of what follows."""
        following = paths.next_observations.flatten(0, 1)
        action = agent.actor.sample(following, generator=agent.generator)[0]
        later = agent.target_critics(following, action).min(0).values.view(paths.rewards.shape)
        low = agent.log_returns.low / agent.return_scale
        targets = lambda_targets(paths, later, low, agent.options.discount).flatten()
        stands = standing(paths)[0][:-1].flatten()
        columns = dict(
            observations=paths.observations.flatten(0, 1),
            actions=paths.actions.flatten(0, 1),
            rewards=targets,
            next_observations=following,
            following_observations=following,
            discounts=torch.zeros_like(targets),
            real=torch.zeros_like(targets),
        )
        return {name: column.detach()[stands] for name, column in columns.items()}

    def ask(self, agent: "ETCQL", actor: Actor, update: int) -> None:
        """Puts an actor on the frontier, with the critics of the moment and what the world model promises of it."""
        promise = promised(self.paths.imagination, actor, episodes=EPISODES, generator=agent.generator)
        agent.frontier.add(actor, agent.critics, update=update, excess=agent.trust.excess(actor), promise=promise)

    def rate(self, progress: float) -> float:
        """The actor's learning rate after this share of the updates: up over the first tenth, down in the last."""
        return self.options.learning_rate * min(10.0 * progress, 1.0, 10.0 * (1.0 - progress))
