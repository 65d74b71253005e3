"""The options of imagined rollouts."""

from dataclasses import dataclass
from typing import Literal

from envtf_lit.options.numbers import Count, Natural, NonNegative, Positive
from envtf_lit.options.schema import rare


@dataclass(frozen=True)
class GenerateRolloutsOptions:
    """The first imagined rollouts, under a policy that was cloned from the log.

    Attributes:
        policy: the section below `train_policy` whose policy acts.
        branches: rollouts, each from a dataset state drawn at random.
        horizon: steps of each rollout, unless the robot falls first.
        history: real steps given to the model before the branch point, at most the model's context less one.
        exploration: scale of the Gaussian noise added to the policy's sampled actions, in units of half the action
            range.
        novelty_limit: rollouts end where the model's epistemic variance passes this multiple of its 0.999 quantile over
            the training data; null lets them go on.
    """

    policy: str = "bc"
    branches: Count = 1_000
    horizon: Count = 5
    history: Natural = 4
    exploration: NonNegative = rare(0.1)
    novelty_limit: Positive | None = 1.0


@dataclass(frozen=True)
class RolloutOptions:
    """The rollouts that a policy imagines while it is trained.

    Attributes:
        branches: rollouts per round, each from a dataset state drawn as the real rows are.
        horizon: steps of each rollout, unless the robot falls first.
        value_expansion: deterministic steps after the horizon, which are not learned from but whose rewards, and end,
            enter the targets of the steps before them (model-based value expansion, Feinberg et al. 2018); 0 learns
            from single imagined steps; fewer where the model's held-out reach (`world_models.fit`) is shorter.
        history: real steps given to the model before the branch point.
        mode: `sample` draws each next state from the model, `mean` takes its mean.
        posterior: above zero each rollout runs in a world model of its own, drawn from the posterior of the last layer
            with its deviation from the mean times this.
        penalty: weight of the uncertainty u, in units of the data's reward standard deviation: `r - weight * std * u`;
            in the value gradient's paths, too.
        novelty_limit: rollouts end where the model's epistemic variance passes this multiple of its 0.999 quantile over
            the training data, and so do the value gradient's paths; null lets them go on.
    """

    branches: Count = 1_500
    horizon: Count = 1
    value_expansion: Natural = 50
    history: Natural = 4
    mode: Literal["mean", "sample"] = rare("sample")
    posterior: NonNegative = 1.0
    penalty: NonNegative = 0.0
    novelty_limit: Positive | None = 1.0
