"""The ensemble: members in one product, the elites' mixture, drawn elites, training to each member's own best."""

import csv
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from envtf_lit import load_world_model
from envtf_lit.data.loaders import Resamples, Windows
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.errors import UserError
from envtf_lit.pipeline.params import Params
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.lit import LitEnsemble
from envtf_lit.world_models.options import EnsembleOptions
from envtf_lit.world_models.store import save_world_model
from tests.test_training import Killed, bytes_of, kill_in_epoch
from tests.walker import walker_dataset

S, A = 5, 2
OPTIONS = EnsembleOptions(
    members=3,
    elites=2,
    hidden=(8, 8),
    weight_decay=(1e-5, 1e-5, 1e-5),
    updates=12,
    updates_per_epoch=4,
    batch_size=8,
)
TINY = Params(
    threads=1,
    precision="fp32",
    train_model={"ensemble": OPTIONS},
)


def make_ensemble(members: int = 4, elites: int = 3) -> EnsembleDynamics:
    torch.manual_seed(0)
    model = EnsembleDynamics(S, A, members=members, elites=elites, hidden=(16, 16)).eval()
    for bias in model.biases:
        bias.data.normal_(0, 0.1)
    model.elite.copy_(torch.tensor([3, 0, 2])[: len(model.elite)])
    model.normaliser.target_std.copy_(torch.linspace(0.5, 2.0, S + 1))
    model.normaliser.observation_mean.copy_(torch.linspace(-1.0, 1.0, S))
    return model.requires_grad_(False)


def start(model: EnsembleDynamics, rows: int, **options):
    observations = torch.randn(1, 1, S, generator=torch.Generator().manual_seed(1)).expand(rows, 1, S)
    return model.init(observations, torch.zeros(rows, 0, A), torch.ones(rows).long(), **options)


def alone(model: EnsembleDynamics, member: int, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """One member as a plain network: mean and log-variance."""
    x = tokens
    for layer, (weight, bias) in enumerate(zip(model.weights, model.biases, strict=True)):
        x = F.linear(x, weight[member].T, bias[member, 0])
        x = F.silu(x) if layer < len(model.weights) - 1 else x
    mean, raw = x.chunk(2, -1)
    low, high = model.log_variance_min[member], model.log_variance_max[member]
    return mean, low + F.softplus(high - F.softplus(high - raw) - low)


# members


def test_members_in_one_product_equal_each_member_alone():
    model, tokens = make_ensemble(), torch.randn(10, S + A)
    means, log_variances = model(tokens)
    for member in range(4):
        mean, log_variance = alone(model, member, tokens)
        torch.testing.assert_close(means[member], mean)
        torch.testing.assert_close(log_variances[member], log_variance)
    own = torch.randn(4, 10, S + A)
    torch.testing.assert_close(model(own)[0][1], alone(model, 1, own[1])[0])


def batch_of(*shape: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    draw = lambda *size: torch.randn(*shape, *size, generator=generator)  # noqa: E731
    return dict(
        observations=draw(S), actions=draw(A), next_observations=draw(S), rewards=draw(), mask=torch.ones(shape)
    )


def test_the_loss_is_the_sum_of_each_members_own():
    model, batch = make_ensemble(), batch_of(4, 6, 1)
    expected = torch.zeros(())
    for member in range(4):
        rows = {name: column[member, :, 0] for name, column in batch.items()}
        token = model.normaliser.token(rows["observations"], rows["actions"])
        target = model.normaliser.target(rows["observations"], rows["next_observations"], rows["rewards"])
        mean, log_variance = alone(model, member, token)
        expected += ((mean - target) ** 2 / log_variance.exp() + log_variance).mean()
        expected += 0.01 * (model.log_variance_max[member] - model.log_variance_min[member]).sum()
    torch.testing.assert_close(model.loss(batch), expected)


def test_padding_does_not_change_the_loss_or_the_error():
    model, batch = make_ensemble(), batch_of(3, 4)
    batch["mask"][1, 2:] = 0.0
    expected = model.loss(batch), *model.squared_error(batch)
    batch["observations"][1, 2:] = 100.0
    for value, again in zip(expected, (model.loss(batch), *model.squared_error(batch)), strict=True):
        torch.testing.assert_close(value, again)


def test_decay_weighs_each_layer():
    model = make_ensemble()
    expected = sum(0.5 * rate * (w**2).sum() for rate, w in zip((1.0, 0.0, 3.0), model.weights, strict=True))
    torch.testing.assert_close(model.decay((1.0, 0.0, 3.0)), expected)


def test_resamples_differ_by_member_and_repeat_rows():
    windows = Windows(walker_dataset(), 1)
    drawn = Resamples(windows, 3, seed=0).drawn
    assert drawn.shape == (3, len(windows)) and not torch.equal(drawn[0], drawn[1])
    share = len(drawn[0].unique()) / len(windows)
    assert share == pytest.approx(1 - math.exp(-1), abs=0.05)
    batch = Resamples(windows, 3, seed=0)[torch.zeros(3, 8, dtype=torch.long)]
    torch.testing.assert_close(batch["observations"][1, 0], windows[drawn[1, :1]]["observations"][0])


# the world model's interface


def test_density_and_moments_are_the_elites_mixture():
    model = make_ensemble()
    state, action = start(model, 50), torch.randn(50, A)
    token = model.normaliser.token(model.current(state), action)
    _, prediction = model.step(state, action, mode="sample", generator=torch.Generator().manual_seed(0))
    scale, shift = model.normaliser.target_std, F.pad(model.current(state), (0, 1))
    every = [alone(model, member, token) for member in range(4)]
    members = [every[member] for member in (3, 0, 2)]
    means = torch.stack([mean * scale + shift for mean, _ in members], 1)  # (B, E, S + 1)
    stds = torch.stack([torch.exp(0.5 * log_variance) * scale for _, log_variance in members], 1)
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(torch.ones(50, 3)),
        torch.distributions.Independent(torch.distributions.Normal(means, stds), 1),
    )
    outcome = torch.cat([prediction.observation, prediction.reward[:, None]], -1)
    torch.testing.assert_close(prediction.log_prob, mixture.log_prob(outcome), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(prediction.mean, mixture.mean, rtol=1e-4, atol=1e-5)
    assert prediction.epistemic is not None and prediction.novelty is not None
    torch.testing.assert_close(prediction.aleatoric.square(), stds.square().mean(1), rtol=1e-3, atol=1e-5)
    spread = torch.stack([mean * scale for mean, _ in every]).var(0, correction=0)  # of all four, not the elites alone
    torch.testing.assert_close(prediction.epistemic.square(), spread, rtol=1e-3, atol=1e-5)
    variance = prediction.aleatoric.square() + prediction.epistemic.square()
    unit = model.normaliser.observation_std
    torch.testing.assert_close(prediction.uncertainty, (variance[:, :-1] / unit**2).mean(-1).sqrt())
    torch.testing.assert_close(prediction.novelty, (prediction.epistemic[:, :-1].square() / unit**2).mean(-1))


def test_samples_follow_one_elite_a_step_and_are_seeded():
    model, rows = make_ensemble(), 30_000
    model.log_variance_max.fill_(-20.0)  # next to no noise: what is left is the choice of the elite
    model.log_variance_min.fill_(-21.0)

    def draw(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return model.step(start(model, rows), torch.zeros(rows, A), mode="sample", generator=generator)[1].reward

    first = draw(0)
    assert torch.equal(first, draw(0)) and not torch.equal(first, draw(1))
    token = model.normaliser.token(model.current(start(model, 1)), torch.zeros(1, A))
    outcomes = torch.stack([alone(model, m, token)[0][0, -1] for m in (3, 0, 2)]) * model.normaliser.target_std[-1]
    nearest = (first[:, None] - outcomes).abs()
    assert nearest.min(1).values.max() < 1e-2
    shares = torch.bincount(nearest.argmin(1), minlength=3) / rows
    torch.testing.assert_close(shares, torch.full((3,), 1 / 3), atol=0.02, rtol=0)


def test_a_rollout_keeps_the_elite_it_drew():
    model = make_ensemble()

    def trace(posterior: float) -> torch.Tensor:
        state, steps = start(model, 64, posterior=posterior, generator=torch.Generator().manual_seed(0)), []
        for t in range(3):
            state, prediction = model.step(state, torch.full((64, A), 0.1 * t))
            state = model.observe(state, model.current(start(model, 64)))  # the same inputs whatever was drawn
            steps.append(prediction.reward - prediction.mean[:, -1])
        return torch.stack(steps)

    once, twice = trace(1.0), trace(2.0)
    assert not trace(0.0).any()
    torch.testing.assert_close(twice, 2 * once, atol=1e-5, rtol=1e-4)
    assert all(len(step.unique()) == 3 for step in once)
    groups = [step.unique(return_inverse=True)[1] for step in once]
    assert all(len((3 * groups[0] + group).unique()) == 3 for group in groups)  # the same rows go together all along
    state = start(model, 64, posterior=1.0, generator=torch.Generator().manual_seed(0))
    _, some = model.step(model.gather(state, torch.tensor([5, 2])), torch.zeros(2, A))
    torch.testing.assert_close(some.reward - some.mean[:, -1], once[0, [5, 2]])


def test_histories_fork_and_gather_go_by_the_current_observation():
    model = make_ensemble()
    observations, actions = torch.randn(3, 4, S), torch.randn(3, 4, A)
    state = model.init(observations, actions[:, :3], torch.tensor([2, 4, 1]))
    torch.testing.assert_close(model.current(state), observations[[0, 1, 2], [1, 3, 0]])
    _, expected = model.step(state, actions[:, 3])
    _, forked = model.step(model.fork(state, 2), actions[:, 3].repeat_interleave(2, 0))
    _, picked = model.step(model.gather(state, torch.tensor([2, 0])), actions[[2, 0], 3])
    torch.testing.assert_close(forked.observation, expected.observation.repeat_interleave(2, 0))
    torch.testing.assert_close(picked.observation, expected.observation[[2, 0]])


def test_gradients_of_the_density_reach_the_members_and_not_the_draw():
    model = make_ensemble().requires_grad_(True)
    draw = model.step(start(model, 4), torch.zeros(4, A), mode="sample", generator=torch.Generator().manual_seed(0))[1]
    (gradient,) = torch.autograd.grad(draw.log_prob.sum(), model.biases[-1], retain_graph=True)
    assert gradient[model.elite, 0, : S + 1].abs().min() > 0  # had the draw moved along, the means would get none
    assert not gradient[1].any()  # no elite


def test_novelty_is_one_at_the_outermost_thousandth_of_the_data():
    model, batch = make_ensemble(), batch_of(2_000, 1)
    model.fit_epistemic([batch], generator=torch.Generator())
    state = model.init(batch["observations"], batch["actions"][:, :0], torch.ones(2_000).long())
    _, prediction = model.step(state, batch["actions"][:, 0])
    assert prediction.novelty is not None
    assert int((prediction.novelty > 1.0 + 1e-6).sum()) == 2


def test_one_member_has_no_epistemic_estimate():
    model = make_ensemble(members=1, elites=1)
    model.elite.zero_()
    model.fit_epistemic([], generator=torch.Generator())
    _, prediction = model.step(start(model, 2), torch.zeros(2, A))
    assert prediction.epistemic is None and prediction.novelty is None and torch.isfinite(prediction.log_prob).all()
    with pytest.raises(UserError, match="one member predicts alone"):
        start(model, 2, posterior=1.0)
    with pytest.raises(UserError, match="An ensemble of 3 has no 5 elites"):
        EnsembleDynamics(S, A, members=3)


def test_saved_ensembles_come_back_whole(tmp_path: Path):
    model = make_ensemble()
    save_world_model(tmp_path / "model", model)
    again = load_world_model(tmp_path / "model")
    assert isinstance(again, EnsembleDynamics) and not again.training and again.arguments == model.arguments
    assert all(torch.equal(a, b) for a, b in zip(model.state_dict().values(), again.state_dict().values(), strict=True))


# training


@pytest.fixture
def root(tmp_path: Path) -> Path:
    save_dataset(walker_dataset().with_split(0.2, 0), tmp_path / "data/dataset.h5")
    return tmp_path


def train(root: Path, params: Params = TINY) -> dict[str, bytes]:
    train_model(params, root, progress=False)
    return bytes_of(root / "models/world_model/ensemble")


def with_options(**options) -> Params:
    return replace(TINY, train_model={"ensemble": replace(OPTIONS, **options)})


def test_the_pipeline_trains_the_ensemble_whose_section_is_of_that_kind(root):
    train(root, with_options(updates=60, updates_per_epoch=20, learning_rate=0.01))
    model = load_world_model(root / "models/world_model/ensemble")
    assert isinstance(model, EnsembleDynamics) and model.limit != 1.0
    with (root / "models/world_model/ensemble/curves.csv").open() as stream:
        losses = [float(row["train/loss"]) for row in csv.DictReader(stream)]
    assert len(losses) == 3 and losses[-1] < losses[0]


def test_a_killed_run_resumes_to_the_same_bits(root, monkeypatch):
    expected = train(root)
    with monkeypatch.context() as patch:
        kill_in_epoch(patch, 2)
        with pytest.raises(Killed):
            train(root)
    assert train(root) == expected


def test_training_stops_when_no_member_improves(root):
    stopping = with_options(updates=400, learning_rate=1e-12, patience=2)
    metrics = train_model(stopping, root, progress=False)
    assert metrics["epoch"] == 3  # the first sets the errors to beat, two more do not


def test_members_are_kept_at_their_best_and_the_best_are_elites():
    data = walker_dataset()
    lit = LitEnsemble(data.observation_dim, data.action_dim, OPTIONS)
    history = []
    for error in ([0.5, 0.3, 0.9], [0.6, 0.299, 0.2], [0.4, 0.1, 0.5]):
        for weight in lit.model.parameters():
            weight.data.fill_(len(history))
        lit._update_best(torch.tensor(error))
        history.append((lit.best.biases[0][:, 0, 0].tolist(), lit.best.elite.tolist(), int(lit.stale)))
    assert history == [
        ([0.0, 0.0, 0.0], [1, 0], 0),
        ([0.0, 0.0, 1.0], [2, 1], 0),  # by 0.3 % is not an improvement
        ([2.0, 2.0, 1.0], [1, 2], 0),
    ]
    lit._update_best(torch.tensor([0.4, 0.1, 0.2]))
    assert int(lit.stale) == 1


@pytest.mark.slow
def test_fused_steps_equal_plain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    through_dynamo = partial(torch.compile, backend="eager")
    plain, fused = make_ensemble(), make_ensemble()
    monkeypatch.setattr(torch, "compile", through_dynamo)
    fused.fuse()
    for rows in (5, 3):
        states = [start(model, rows) for model in (plain, fused)]
        for step in range(3):
            for number, model in enumerate((plain, fused)):
                torch.manual_seed(step)
                states[number], _ = model.step(states[number], torch.randn(rows, A), mode="sample")
            torch.testing.assert_close(states[1].observation, states[0].observation)
