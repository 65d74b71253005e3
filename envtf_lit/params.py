"""Every option of every stage, with its default, unit and meaning: the schema of `params.yaml`."""

from dataclasses import dataclass, field
from typing import Literal

Precision = Literal["fp32", "bf16"]


@dataclass(frozen=True)
class DownloadOptions:
    """Where the dataset comes from.

    Attributes:
        source: `zoo` lets the shipped behaviour policies act in MuJoCo; `file` reads a file of yours; `d4rl` and
            `minari` fetch those collections' datasets, or read a copy.
        path: the HDF5 or NPZ file of `source: file`; of `source: d4rl` a copy of its file, null downloads it.
        minari_id: of `source: minari`, such as `mujoco/hopper/medium-v0`, or its folder.
        transitions: rows to collect from the zoo.
    """

    source: Literal["zoo", "file", "d4rl", "minari"] = "zoo"
    path: str | None = None
    minari_id: str | None = None
    transitions: int = 100_000


@dataclass(frozen=True)
class ModelOptions:
    """The Environment Transformer's architecture and objective.

    Attributes:
        layers: transformer blocks.
        heads: attention heads; divides `width` into even parts.
        width: embedding dimension.
        context: tokens (steps) that attention reaches back, in training and in generation.
        dropout: probability, in the residual branches.
        activation: nonlinearity of the feed-forward layers.
        objective: `beta_nll` (Seitzer et al. 2022), `nll`, or `paper_mse` (the paper's sampled mse, which drives every
            variance to zero).
        target: `delta` predicts the scaled change of the state, `absolute` the z-scored next state (the paper's form).
        epistemic: where epistemic variance comes from: `laplace`, the posterior of the last layer, fitted after
            training; `head`, the paper's third head, trained with the rest; `none`.
        random_features: of the state-action pair, which the posterior of `laplace` sees beside the last hidden token:
            more detect strange pairs better, and its time grows with their square.
        bounded: predictions stay within the range of the training data, widened by a tenth of it at either end, so that
            no rollout runs away.
        scheduled_sampling: share of the input states that, in training, are the model's own predictions, which it
            learns to correct; above 0 a second forward pass per update.
        multi_step: passes per update, each from the states that the one before predicted, with gradients through all;
            1 trains one-step prediction alone.
        any_step: largest share of the states that are hidden in training, drawn for each window: predictions then start
            from the last state shown, and follow the actions alone.
    """

    layers: int = 4
    heads: int = 4
    width: int = 128
    context: int = 16
    dropout: float = 0.0
    activation: Literal["relu", "gelu"] = "gelu"
    objective: Literal["beta_nll", "nll", "paper_mse"] = "beta_nll"
    target: Literal["delta", "absolute"] = "delta"
    epistemic: Literal["laplace", "head", "none"] = "laplace"
    random_features: int = 128
    bounded: bool = False
    scheduled_sampling: float = 0.0
    multi_step: int = 1
    any_step: float = 0.0


@dataclass(frozen=True)
class EnsembleOptions:
    """The ensemble of Gaussian networks of MBPO, MOPO, COMBO and RAMBO, and how it is trained.

    Attributes:
        members: networks, each trained on a bootstrap resample of its own.
        elites: members of least held-out error, the ones that predict.
        hidden: units of each hidden layer.
        updates: gradient steps at most.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: rows per gradient step and member.
        learning_rate: Adam's.
        weight_decay: of each layer, the output layer last: half this times the squared weights is added to the loss.
        patience: epochs without a member whose held-out error falls by 1 %, after which training stops.
    """

    members: int = 7
    elites: int = 5
    hidden: tuple[int, ...] = (200, 200, 200, 200)
    updates: int = 100_000
    updates_per_epoch: int = 500
    batch_size: int = 256
    learning_rate: float = 0.001
    weight_decay: tuple[float, ...] = (0.000025, 0.00005, 0.000075, 0.000075, 0.0001)
    patience: int = 5


@dataclass(frozen=True)
class TrainModelOptions:
    """How the world model is trained.

    Attributes:
        model: architecture and objective.
        ensemble: a section trains the ensemble in place of the transformer, and of this section only `held_out` is
            read beside it; null trains the transformer.
        updates: gradient steps in all.
        updates_per_epoch: gradient steps between two validations (and resumable checkpoints).
        batch_size: windows of `model.context` steps per gradient step.
        learning_rate: peak, reached after `warmup` of the updates, then a cosine to zero.
        warmup: share of the updates, in [0, 1).
        weight_decay: AdamW's, on matrices only.
        eps: AdamW's.
        gradient_clip: largest gradient norm.
        held_out: share of the episodes kept for validation.
    """

    model: ModelOptions = field(default_factory=ModelOptions)
    ensemble: EnsembleOptions | None = None
    updates: int = 6_000
    updates_per_epoch: int = 1_000
    batch_size: int = 32
    learning_rate: float = 0.001
    warmup: float = 0.05
    weight_decay: float = 0.0001
    eps: float = 0.00000001
    gradient_clip: float = 1.0
    held_out: float = 0.1


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


@dataclass(frozen=True)
class PolicyOptions:
    """Conservative Q-Learning (Kumar et al. 2020) on data, or on data and imagination.

    Attributes:
        updates: gradient steps in all, the warm start included.
        updates_per_epoch: gradient steps between two log lines (and resumable checkpoints).
        updates_per_step: gradient steps per Lightning training step.
        batch_size: rows per gradient step.
        hidden: units of each hidden layer of actor and critics.
        critics: Q-functions, of which the target takes the smallest.
        layer_norm: LayerNorm in the critics.
        discount: of future rewards, per step.
        normalise_returns: divides rewards by the standard deviation of the log's Monte-Carlo returns, so that Q has
            unit spread on any robot and the other weights mean the same everywhere.
        return_temperature: real rows are drawn with chances exp(episode return / temperature), returns scaled to
            [0, 1], so that a mostly poor log teaches what its best episodes did; null draws uniformly.
        n_step: real steps whose rewards enter the temporal-difference target.
        target_rate: share of the critics that enters the target networks at each update.
        actor_learning_rate: Adam's.
        actor_schedule: of the actor's learning rate after the warm start: `constant`, or half a cosine to zero.
        critic_learning_rate: Adam's.
        cql_weight: weight of the conservative term.
        initial_alpha: weight of the entropy in the actor's objective at the start; learned from there on.
        clone_weight: weight in the actor's objective of cloning the real rows' actions, which keeps it near the log.
        sampled_actions: actions of each kind (uniform, pi(s), pi(s')) in the log-sum-exp.
        temperature: of the log-sum-exp.
        warm_start: first updates, in which the critics fit Monte-Carlo returns and the actor clones the data.
        warm_start_learning_rate: Adam's, of both, during the warm start.
        actor_average: share of the actor that enters the averaged actor at each update; the average is what is saved.
        imagination: None trains on data alone.
    """

    updates: int = 4_500
    updates_per_epoch: int = 500
    updates_per_step: int = 10
    batch_size: int = 256
    hidden: tuple[int, ...] = (256, 256)
    critics: int = 2
    layer_norm: bool = True
    discount: float = 0.997
    normalise_returns: bool = True
    return_temperature: float | None = 0.1
    n_step: int = 20
    target_rate: float = 0.005
    actor_learning_rate: float = 0.0003
    actor_schedule: Literal["constant", "cosine"] = "cosine"
    critic_learning_rate: float = 0.0003
    cql_weight: float = 0.1
    initial_alpha: float = 0.01
    clone_weight: float = 0.25
    sampled_actions: int = 2
    temperature: float = 1.0
    warm_start: int = 1_500
    warm_start_learning_rate: float = 0.001
    actor_average: float = 0.002
    imagination: ImaginationOptions | None = None


@dataclass(frozen=True)
class TrainPolicyOptions:
    """The two policies that are compared, with equal budgets.

    Attributes:
        cql: data alone.
        et_cql: data and imagination.
    """

    cql: PolicyOptions = field(default_factory=PolicyOptions)
    et_cql: PolicyOptions = field(default_factory=lambda: PolicyOptions(imagination=ImaginationOptions()))


@dataclass(frozen=True)
class EvaluateOptions:
    """The evidence.

    Attributes:
        episodes: MuJoCo episodes per policy, seeded `seed + 1000 + i`.
        trajectories: held-out episodes on which the world model is scored over long horizons.
        video_frames: frames of the real-versus-imagined video, at most 150.
    """

    episodes: int = 20
    trajectories: int = 50
    video_frames: int = 150


@dataclass(frozen=True)
class Params:
    """All of `params.yaml`.

    Attributes:
        task: robot and tier, such as `hopper-medium-replay`, or null for a robot of your own.
        seed: of everything random.
        threads: CPU threads of each stage; part of what makes results equal to the bit.
        precision: of matrix products in training and imagination; losses and optimisers stay in fp32.
        compile: world models train and imagine through torch.compile, which takes a minute to begin with: pays on a
            GPU, where launching their many small operations is what takes the time.
        download: the dataset.
        train_model: the world model.
        generate_rollouts: the behaviour clone and its imagined rollouts.
        train_policy: the policies.
        evaluate: the evidence.
    """

    task: str | None = "hopper-medium-replay"
    seed: int = 0
    threads: int = 2
    precision: Precision = "bf16"
    compile: bool = False
    download: DownloadOptions = field(default_factory=DownloadOptions)
    train_model: TrainModelOptions = field(default_factory=TrainModelOptions)
    generate_rollouts: GenerateRolloutsOptions = field(default_factory=GenerateRolloutsOptions)
    train_policy: TrainPolicyOptions = field(default_factory=TrainPolicyOptions)
    evaluate: EvaluateOptions = field(default_factory=EvaluateOptions)
