"""The last layer's posterior: exact where theory is, wide where there are no data, calibrated on both."""

import pytest
import torch
from torch import Tensor, nn

from envtf_lit.world_models.objectives import beta_nll, paper_mse
from envtf_lit.world_models.options import ModelOptions
from envtf_lit.world_models.uncertainty.laplace import RIDGE, SPREAD, LastLayerLaplace, RandomFeatures, clusters


def fitted(hidden: Tensor, targets: Tensor, *, groups: Tensor | None = None) -> LastLayerLaplace:
    laplace = LastLayerLaplace(hidden.shape[1], targets.shape[1]).double()
    groups = torch.arange(len(hidden)) % 5 if groups is None else groups
    laplace.fit(hidden, targets, torch.zeros_like(targets), torch.full_like(targets, 0.1), groups)
    return laplace


def test_equals_bayesian_linear_regression():
    generator = torch.Generator().manual_seed(0)
    hidden = torch.randn(300, 8, generator=generator, dtype=torch.float64)
    targets = torch.randn(300, 3, generator=generator, dtype=torch.float64)
    laplace, query = fitted(hidden, targets), 3 * torch.randn(20, 8, generator=generator, dtype=torch.float64)
    tokens, asked = (torch.cat([torch.ones(len(x), 1).double(), x], 1) for x in (hidden, query))
    noise = targets.square().mean(0)  # residuals of a mean of zero
    for k in range(
        3
    ):  # weights N(0, noise / lambda I), outcomes with variance noise: the predictive variance less noise
        prior = noise[k] / RIDGE * torch.eye(9, dtype=torch.float64)
        gain = prior @ tokens.T @ torch.linalg.inv(tokens @ prior @ tokens.T + noise[k] * torch.eye(300).double())
        posterior = prior - gain @ tokens @ prior
        expected = laplace.scale * torch.einsum("nd,de,ne->n", asked, posterior, asked)
        torch.testing.assert_close(laplace.variance(laplace.leverage(query))[:, k], expected, rtol=1e-6, atol=0)


def test_novelty_is_one_at_the_edge_of_the_training_data():
    hidden = torch.randn(5_000, 4, generator=torch.Generator().manual_seed(0)).double()
    laplace = fitted(hidden, hidden[:, :1])
    beyond = (laplace.leverage(hidden) > laplace.limit).double().mean()
    assert float(beyond) == pytest.approx(0.001, abs=2e-4)


def test_the_scale_is_what_left_out_groups_need():
    """Residuals of an unseen group are drawn four times as wide as q says: c must say so."""
    generator = torch.Generator().manual_seed(0)
    hidden = torch.randn(4_000, 4, generator=generator).double()
    laplace = LastLayerLaplace(4, 1).double()
    slope = torch.randn(20, 4, 1, generator=generator).double()  # each group has its own regression
    groups = torch.arange(4_000) % 20
    targets = torch.einsum("nd,ndk->nk", hidden, slope[groups])
    mean, tiny = targets - 0.01, torch.full_like(targets, 1e-8)
    laplace.fit(hidden, targets, mean, tiny, groups)
    spread = laplace.variance(laplace.leverage(hidden)).mean()
    assert 0.5 < float(spread / (targets - targets.mean()).square().mean()) < 2.0


def test_drawn_layers_vary_as_the_variance_says():
    generator = torch.Generator().manual_seed(0)
    hidden = torch.randn(500, 6, generator=generator).double()
    laplace = fitted(hidden, hidden[:, :2])
    drawn, query = laplace.draw(20_000, generator), torch.full((20_000, 6), 0.7).double()
    deviation = laplace.deviation(query, drawn)
    torch.testing.assert_close(deviation.var(0), laplace.variance(laplace.leverage(query[0])), rtol=0.05, atol=0)
    again = laplace.deviation(query, drawn)
    assert torch.equal(deviation, again) and not torch.equal(deviation[0], deviation[1])


def random_features(x: Tensor, count: int, seed: int = 0) -> RandomFeatures:
    random = RandomFeatures(x.shape[1], count)
    random.fit(x, torch.Generator().manual_seed(seed))
    return random


def test_draws_vary_the_hidden_tokens_weights_alone():
    generator = torch.Generator().manual_seed(0)
    hidden, further = (torch.randn(500, n, generator=generator).double() for n in (6, 9))
    groups, mean, noise = torch.arange(500) % 5, torch.zeros(500, 2).double(), torch.ones(500, 2).double()
    alone, both = LastLayerLaplace(6, 2).double(), LastLayerLaplace(6, 2, further=9).double()
    alone.fit(hidden, hidden[:, :2], mean, noise, groups)
    both.fit(torch.cat([hidden, further], 1), hidden[:, :2], mean, noise, groups)
    both.scale.copy_(alone.scale)
    drawn = both.draw(500, generator)
    assert drawn.shape == (500, 7, 2)
    torch.testing.assert_close(both.deviation(hidden, drawn), alone.deviation(hidden, drawn))
    assert (both.leverage(torch.cat([hidden, further], 1)) > alone.leverage(hidden)).all()


def test_random_features_tell_apart_what_the_hidden_token_confuses():
    """The hidden token knows the first of two inputs alone; strange pairs differ in the second."""
    torch.manual_seed(0)
    x, strange = torch.randn(2_000, 2), torch.randn(2_000, 2) + torch.tensor([0.0, 6.0])
    hidden, random = (lambda x: torch.tanh(x[:, :1])), random_features(x, 64)
    for seen, least, most in ((hidden, 0.4, 0.6), (lambda x: torch.cat([hidden(x), random(x)], -1), 0.999, 1.0)):
        laplace = fitted(seen(x).double(), x[:, :1].double())
        found = auroc(laplace.leverage(seen(x).double()), laplace.leverage(seen(strange).double()))
        assert least <= found <= most


def test_random_features_see_whitened_inputs_and_grow_with_distance():
    torch.manual_seed(0)
    x = torch.randn(2_000, 3) * torch.tensor([1.0, 0.3, 1.0]) + 5  # the middle one varies little
    random = random_features(x, 1_000)
    plain = random_features((x - 5) * torch.tensor([1.0, 1 / 0.3, 1.0]), 1_000)
    assert float(random(x).square().mean()) == pytest.approx(float(plain((x - 5) / x.std(0)).square().mean()), rel=0.1)
    far = nn.functional.normalize(torch.randn(3), dim=0)
    growth = random(100 * far).square().mean() / random(50 * far).square().mean()
    assert float(growth) == pytest.approx(4, rel=0.3)
    assert torch.equal(random.weight, random_features(x, 1_000).weight)
    assert not torch.equal(random.weight, random_features(x, 1_000, seed=1).weight)
    assert random_features(x, 0)(x).shape == (2_000, 0)


def test_directions_point_everywhere_alike():
    """Blocks of a QR decomposition alone lean to one side of each axis."""
    x = torch.randn(20_000, 5, generator=torch.Generator().manual_seed(0))
    weight = random_features(x, 20_000).weight / SPREAD  # nearly unit covariance / 5
    assert float(weight.mean(0).abs().max()) < 0.015
    torch.testing.assert_close(5 * weight.T @ weight / len(weight), torch.eye(5), atol=0.1, rtol=0)
    blocks = weight[:5] @ weight[:5].T
    assert float((blocks - blocks.diagonal().diag()).abs().max()) < 0.1  # orthogonal, but for the whitening
    signs = (weight.view(-1, 5, 5).diagonal(dim1=1, dim2=2) > 0).double().mean(0)
    assert ((signs > 0.45) & (signs < 0.55)).all()


def test_constant_inputs_are_not_seen_and_leave_nothing_to_chance():
    """Two constant columns share an eigenvalue, whose eigenvectors are arbitrary."""
    x = torch.cat([torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), torch.ones(500, 2)], 1)
    random = random_features(x, 16)
    assert not random.weight[:, 3:].any() and random(x).isfinite().all()
    disturbed = random_features(x + 1e-8 * torch.randn(500, 5), 16)
    torch.testing.assert_close(disturbed.weight, random.weight, atol=1e-4, rtol=1e-4)
    assert random_features(torch.ones(10, 1), 2)(torch.ones(1, 1)).isfinite().all()


def test_leverage_is_as_exact_in_half_precision():
    generator = torch.Generator().manual_seed(0)
    hidden = torch.randn(2_000, 32, generator=generator) @ torch.randn(32, 32, generator=generator)
    laplace = LastLayerLaplace(32, 1)
    laplace.fit(hidden, hidden[:, :1], torch.zeros(2_000, 1), torch.ones(2_000, 1), torch.arange(2_000) % 5)
    drawn = laplace.draw(2_000, generator)
    leverage, deviation = laplace.leverage(hidden), laplace.deviation(hidden, drawn)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(laplace.leverage(hidden), leverage)
        assert random_features(hidden, 8)(hidden).dtype == torch.float32
        torch.testing.assert_close(laplace.deviation(hidden, drawn).float(), deviation, rtol=0.1, atol=0.01)


def test_until_it_is_fitted_it_says_zero():
    laplace = LastLayerLaplace(4, 2)
    assert not laplace.variance(laplace.leverage(torch.randn(3, 4))).any()


def test_clusters_find_well_separated_groups():
    centres = 10.0 * torch.eye(4)
    truth = torch.arange(400) % 4
    points = centres[truth] + 0.1 * torch.randn(400, 4, generator=torch.Generator().manual_seed(0))
    found = clusters(points, torch.Generator().manual_seed(1), count=20)
    for group in found.unique():
        assert len(truth[found == group].unique()) == 1
    assert torch.equal(found, clusters(points, torch.Generator().manual_seed(1), count=20))


# A regression whose every number is known: y = sin 2x + noise that widens with x, no data in a gap.


def noise(x: Tensor) -> Tensor:
    return 0.05 + 0.3 * torch.sigmoid(2 * x)


def toy_data(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    x = 1 + 2 * torch.rand(count, 1, generator=generator)
    x = torch.where(torch.rand(count, 1, generator=generator) < 0.5, x, -x)
    return x, torch.sin(2 * x) + noise(x) * torch.randn(count, 1, generator=generator)


class Toy(nn.Module):
    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(1, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
        self.head, self.laplace = nn.Linear(64, outputs), LastLayerLaplace(64, 1)


def train_toy(objective: str, *, learning_rate: float = 3e-3) -> tuple[Toy, Tensor, Tensor]:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    x, y = toy_data(1_000, generator)
    toy = Toy(2 if objective == "beta_nll" else 3)
    optimizer = torch.optim.Adam(toy.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 1_500)
    for _ in range(1_500):
        rows = torch.randint(len(x), (256,), generator=generator)
        outputs = toy.head(toy.trunk(x[rows])).split(1, dim=-1)
        if objective == "beta_nll":
            loss = beta_nll(outputs[0], outputs[1], y[rows]).mean()
        else:
            loss = paper_mse(outputs[0], outputs[1], outputs[2], y[rows], generator=generator).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return toy, x, y


def auroc(inside: Tensor, outside: Tensor) -> float:
    return float((outside[:, None] > inside[None]).double().mean())


def test_a_toy_with_a_gap_is_calibrated_and_its_gap_is_seen():
    toy, x, y = train_toy("beta_nll")
    with torch.no_grad():
        hidden = toy.trunk(x)
        mean, log_variance = toy.head(hidden).split(1, dim=-1)
        toy.laplace.fit(hidden, y, mean, log_variance.exp(), clusters(x, torch.Generator().manual_seed(0)))
        fresh, outcome = toy_data(20_000, torch.Generator().manual_seed(1))
        leverage = toy.laplace.leverage(toy.trunk(fresh))
        mean, log_variance = toy.head(toy.trunk(fresh)).split(1, dim=-1)
        aleatoric = torch.exp(0.5 * log_variance)
        gap = toy.laplace.leverage(toy.trunk(torch.linspace(-0.7, 0.7, 200)[:, None]))
    assert 0.9 < float((aleatoric / noise(fresh)).mean()) < 1.1
    assert 0.87 < float(((outcome - mean).abs() < 1.645 * aleatoric).double().mean()) < 0.93
    assert auroc(leverage[:2_000], gap) > 0.95


def test_the_papers_loss_drives_the_spread_to_nothing():
    toy, x, _ = train_toy("paper_mse", learning_rate=1e-2)  # sooner there
    with torch.no_grad():
        _, aleatoric, epistemic = toy.head(toy.trunk(x)).split(1, dim=-1)
        spread = torch.sqrt(aleatoric.exp() + epistemic.exp())
    assert float((spread / noise(x)).mean()) < 0.1  # and falling


def test_default_epistemic_variance_is_the_posterior():
    assert ModelOptions().epistemic == "laplace"
