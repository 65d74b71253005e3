"""The options of imagined rollouts and of what agents do with them."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class GenerateRolloutsOptions:
    """The first imagined rollouts, under a clone of the behaviour policy.

    Attributes:
        clone_updates: gradient steps of the behaviour clone.
        clone_batch_size: rows per gradient step of the clone.
        branches: rollouts, each from a dataset state drawn at random.
        horizon: steps of each rollout, unless the robot falls first.
        history: real steps given to the model before the branch point, at most `context - 1`.
        share: rollouts that begin within as many consecutive steps of one window, which the model reads once; they
            have up to `share - 1` steps more behind them.
        exploration: scale of the Gaussian noise added to the clone's sampled actions, in units of the action range's
            half.
        mode: `sample` draws each next state from the model, `mean` takes its mean.
        novelty_limit: rollouts end where the model's epistemic variance passes this multiple of its 0.999 quantile over
            the training data; null lets them go on.
    """

    clone_updates: int = 2_000
    clone_batch_size: int = 512
    branches: int = 20_000
    horizon: int = 5
    history: int = 4
    share: int = 16
    exploration: float = 0.1
    mode: Literal["mean", "sample"] = "sample"
    novelty_limit: float | None = 1.0


@dataclass(frozen=True)
class ValueGradientOptions:
    """The last updates of a policy that imagines: its actor follows the gradient of imagined returns (SHAC, Xu 2022).

    Attributes:
        updates: of all the policy's updates, the last so many; each is one of the actor.
        rollouts: imagined at a time; each is carried on from update to update until the robot falls.
        horizon: steps of each rollout per update, after which a learned state value stands for what follows.
        max_steps: after which a rollout begins anew at a real state.
        trace: lambda of the state value's TD(lambda) targets.
        value_passes: of the state value over the steps of each update.
        value_learning_rate: Adam's.
        learning_rate: Adam's, of the actor; reached after a tenth of these updates, from there linearly to zero.
        clone_weight: weight in the actor's objective of cloning the real rows' actions.
        actor_average: share of the actor that enters the averaged actor at each of these updates.
    """

    updates: int = 400
    rollouts: int = 64
    horizon: int = 16
    max_steps: int = 1_000
    trace: float = 0.95
    value_passes: int = 4
    value_learning_rate: float = 0.001
    learning_rate: float = 0.001
    clone_weight: float = 0.05
    actor_average: float = 0.05


@dataclass(frozen=True)
class ImaginationOptions:
    """How imagined transitions enter policy learning.

    Attributes:
        real_ratio: share of real rows in each batch, in (0, 1].
        refresh_every: updates between two rounds of new rollouts under the current policy; 0 keeps the stored ones
            (the paper's fixed buffer).
        branches: rollouts per round.
        horizon: steps of each rollout, unless the robot falls first.
        tail: deterministic steps after the horizon, which are not learned from but whose rewards, and end, enter the
            targets of the steps before them (model-based value expansion, Feinberg et al. 2018).
        history: real steps given to the model before the branch point.
        share: rollouts that begin within as many consecutive steps of one window, which the model reads once, with up
            to `share - 1` steps more behind them: it pays where rollouts are short.
        mode: `sample` draws each next state from the model, `mean` takes its mean.
        posterior: above zero each rollout runs in a world model of its own, drawn from the posterior of the last layer
            with its deviation from the mean times this.
        buffer_size: imagined transitions kept; the oldest leave first.
        multi_step: temporal-difference targets run to the end of the imagined rollout, not one step.
        penalty: weight of the uncertainty u, in units of the data's reward standard deviation: `r - weight * std * u`.
        novelty_limit: rollouts end where the model's epistemic variance passes this multiple of its 0.999 quantile over
            the training data; null lets them go on.
        penalty_up_on: rows on which the conservative term pushes Q up: `real` (COMBO's form) or `mixture` (the
            paper's equation 5 read literally, which rewards the policy's own imagined actions).
        selection_episodes: imagined episodes that judge the averaged actor after each epoch, from recorded first
            states; the actor of highest imagined return is kept. 0 keeps the last.
        selection_steps: of each such episode at most.
        value_gradient: the end of the training, in which the actor follows the gradient through the world model; null
            leaves all updates to CQL.
    """

    real_ratio: float = 0.75
    refresh_every: int = 250
    branches: int = 1_500
    horizon: int = 1
    tail: int = 50
    history: int = 4
    share: int = 1
    mode: Literal["mean", "sample"] = "sample"
    posterior: float = 1.0
    buffer_size: int = 4_500
    multi_step: bool = True
    penalty: float = 0.0
    novelty_limit: float | None = 1.0
    penalty_up_on: Literal["real", "mixture"] = "real"
    selection_episodes: int = 0
    selection_steps: int = 1_000
    value_gradient: ValueGradientOptions | None = field(default_factory=ValueGradientOptions)
