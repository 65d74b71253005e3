"""Last-layer Laplace approximation: epistemic variance, large where a token is far from those of the training data.

A score of the outcome sees only the sum of aleatoric and epistemic variance, so no head can learn to tell them apart.
The last layer, though, is a linear regression on the hidden token, and for that the posterior is known in closed form
(the Laplace approximation, here exact up to the noise): it is wide where no training token pointed.

A network may map out-of-distribution inputs onto in-distribution hidden tokens, since nothing in training asked it to
tell them apart. So the regression is given random features of the input beside them, which keep apart what differs. Its
posterior is as wide as an ensemble of linear heads on all of them, with random priors (Osband et al. 2018), would be.
Its mean is not used: predictions are the trained head's, and draws vary this head's own weights alone.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envtf_lit.data.statistics import CONSTANT

RIDGE = 1e-2  # lambda: the prior's precision, in units of the (unweighted) noise
CLUSTERS, LLOYD_ITERATIONS = 10, 20
SCALES = torch.logspace(-4, 8, 121, dtype=torch.float64)  # candidates for c
OUTSIDE = 0.999  # quantile of the training tokens' leverage beyond which a token counts as new
BLOCK = 4_096  # tokens whose likelihoods are computed at a time
STRIPS = 4  # of rows of W, whose zeros beyond the diagonal are left out of the products
SPREAD = (
    4.0  # standard deviation of random features before they are rectified, offsets have one of 1; see calibration.md
)
NARROW = 0.01  # of the largest variance, below which a direction's counts as that when the input is whitened


class RandomFeatures(nn.Module):
    """Random ReLU features: `count` rectified random projections of the whitened input.

    As features (Rahimi and Recht 2007) of the arc-cosine kernel (Cho and Saul 2009), their directions orthogonal as far
    as there are dimensions (Yu et al. 2016). Zero until `fit`.

    Attributes:
        weight: (M, F), `offset`: (M,).
    """

    weight: Tensor
    offset: Tensor

    def __init__(self, inputs: int, count: int) -> None:
        super().__init__()
        self.register_buffer("weight", torch.zeros(count, inputs))
        self.register_buffer("offset", torch.zeros(count))

    def fit(self, x: Tensor, generator: torch.Generator) -> None:
        """Draws the projections, blind to how strongly inputs (N, F) vary in which direction (down to `NARROW`)."""
        count, inputs = self.weight.shape
        mean, whiten = x.double().mean(0), _whitening(x.double())
        blocks = torch.randn(-(-count // inputs), inputs, inputs, generator=generator)
        lengths = torch.randn(count, inputs, generator=generator).norm(dim=1).to(whiten)
        offset = torch.randn(count, generator=generator).to(whiten)
        drawn = _rotations(blocks).flatten(0, 1)[:count].to(whiten)  # of length one, orthogonal in each block
        weight = SPREAD * inputs**-0.5 * (drawn * lengths[:, None]) @ whiten
        self.weight.copy_(weight)
        self.offset.copy_(offset - weight @ mean)

    def forward(self, x: Tensor) -> Tensor:
        """Inputs (..., F) to features (..., M), in fp32 whatever the precision around it."""
        with torch.autocast(x.device.type, enabled=False):
            return F.relu(F.linear(x.to(self.weight.dtype), self.weight, self.offset))


class LastLayerLaplace(nn.Module):
    """Posterior of the last layer, and the epistemic variance that follows: `S_eu(x) = c diag(R) q(x)`.

    The leverage is `q = phi^T (Phi^T Phi + lambda I)^-1 phi`, phi = [1, features].

    Features are what the last layer sees, the hidden token, and behind it what it might have seen, random features.
    Until `fit` it knows no data and says zero.

    Args:
        width: D, of the hidden token.
        outputs: K.
        further: features behind the hidden token; P = D + further in all.

    Attributes:
        root: (P + 1, P + 1) W, lower-triangular, with `W^T W = (Phi^T Phi + lambda I)^-1`, so that `q = |W phi|^2`.
        residual: (K,) R, the variance of the training residuals of each output.
        scale: c, by which residuals of the regression, on clusters of data left out of it, exceed what q says.
        limit: the 0.999 quantile of q over the training tokens.
    """

    root: Tensor
    residual: Tensor
    scale: Tensor
    limit: Tensor

    def __init__(self, width: int, outputs: int, further: int = 0) -> None:
        super().__init__()
        self.width = width
        self.register_buffer("root", torch.zeros(width + further + 1, width + further + 1))
        self.register_buffer("residual", torch.zeros(outputs))
        self.register_buffer("scale", torch.zeros(()))
        self.register_buffer("limit", torch.ones(()))

    def leverage(self, features: Tensor) -> Tensor:
        """q of features (..., P), (...), at least zero; at most one at a training token."""
        squares = (strip.square().sum(-1) for strip in self._whitened(features))
        return sum(squares, start=self.root[0, 0].square())

    def _whitened(self, features: Tensor) -> list[Tensor]:
        """W phi (..., P) in strips, without its first entry, W_00. Terms cancel: half precision would leave noise."""
        features, P = features.to(self.root.dtype), features.shape[-1]
        ends = [P * strip // STRIPS for strip in range(STRIPS + 1)]
        with torch.autocast(features.device.type, enabled=False):
            rows = [(self.root[begin + 1 : end + 1], end) for begin, end in pairwise(ends)]
            return [F.linear(features[..., :end], row[:, 1 : end + 1], row[:, 0]) for row, end in rows]

    def variance(self, leverage: Tensor) -> Tensor:
        """S_eu (..., K), in the unit scale of the targets."""
        return self.scale * leverage[..., None] * self.residual

    def draw(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Last layers drawn from the posterior, as deviations from the trained one: (count, D + 1, K) on q's root.

        Of the hidden token's weights, given that those of further features are zero, as they are in the model:
        functions of random features are rough, and the gradient of a return through them misleads an actor.
        """
        size = (count, self.width + 1, len(self.residual))
        return torch.randn(size, generator=generator, device=self.root.device, dtype=self.root.dtype)

    def deviation(self, hidden: Tensor, drawn: Tensor) -> Tensor:
        """What drawn last layers (B, D + 1, K) add to the mean at hidden tokens (B, D): (B, K).

        Its variance is S_eu as the hidden token alone would have it, whose root is the head of W.
        """
        with torch.autocast(hidden.device.type, enabled=False):
            own = self.root[1 : self.width + 1, : self.width + 1]
            whitened = F.linear(hidden.to(own.dtype), own[:, 1:], own[:, 0])
            sums = self.root[0, 0] * drawn[:, 0] + torch.einsum("bd,bdk->bk", whitened, drawn[:, 1:])
        return sums * (self.scale * self.residual).sqrt()

    def fit(self, features: Tensor, targets: Tensor, mean: Tensor, aleatoric: Tensor, groups: Tensor) -> None:
        """Takes the posterior from N training tokens, and c from what happens to groups that it has not seen.

        In-distribution data want no epistemic variance, so they cannot set its scale. For each group the last layer
        is solved anew without it, and c maximises the likelihood of that group's residuals under
        `N(0, S_au + c R q)`, q without the group too.

        Args:
            features: (N, P) of the training tokens.
            targets, mean, aleatoric: (N, K) what they should predict, what they do, with which variance; unit scale.
            groups: (N,) int64, such as `clusters` gives.
        """
        tokens, targets = F.pad(features, (1, 0), value=1.0).double(), targets.double()
        residual = (targets - mean).square().mean(0)  # (K,)
        gram, moment = tokens.T @ tokens, tokens.T @ targets
        surprise = torch.zeros_like(SCALES)
        for group in groups.unique():
            mine = (groups == group).nonzero()[:, 0]
            own = tokens[mine]
            root = _root(gram - own.T @ own)
            solution = root.T @ (root @ (moment - own.T @ targets[mine]))  # (P + 1, K), ridge regression
            for rows in mine.split(BLOCK):
                squared = (targets[rows] - tokens[rows] @ solution).square()
                spread = (tokens[rows] @ root.T).square().sum(-1)[:, None] * residual
                surprise += _surprise(squared, aleatoric[rows].double(), spread)
        root = _root(gram)
        self.root.copy_(root)
        self.residual.copy_(residual)
        self.scale.copy_(SCALES[surprise.argmin()])
        self.limit.copy_(quantile((tokens @ root.T).square().sum(-1), OUTSIDE))


def clusters(points: Tensor, generator: torch.Generator, count: int = CLUSTERS) -> Tensor:
    """(N,) int64: which of up to `count` k-means clusters (Lloyd's algorithm) each of the points (N, F) belongs to."""
    start = torch.randperm(len(points), generator=generator)[:count].to(points.device)
    centres = points[start]
    nearest = torch.cdist(points, centres).argmin(1)
    for _ in range(LLOYD_ITERATIONS):
        sums = torch.zeros_like(centres).index_add_(0, nearest, points)
        sizes = torch.bincount(nearest, minlength=len(centres)).clamp(min=1)
        centres = sums / sizes[:, None]
        nearest = torch.cdist(points, centres).argmin(1)
    return nearest


def _whitening(x: Tensor) -> Tensor:
    """(F, F), symmetric: gives inputs (N, F) unit variance in all directions in which they vary; constants count not.

    Symmetric, for eigenvectors alone are arbitrary in sign, and where variances are alike.
    """
    covariance = torch.cov(x.T).reshape(x.shape[1], x.shape[1])
    variances, directions = torch.linalg.eigh(covariance)
    least = max(NARROW * float(variances[-1]), CONSTANT**2)
    whitening = directions / variances.clamp(min=least).sqrt() @ directions.T
    return whitening * (covariance.diagonal() >= CONSTANT**2)


def _rotations(blocks: Tensor) -> Tensor:
    """Normal matrices (..., F, F) to uniformly random orthogonal ones (Mezzadri 2007)."""
    rotations, triangles = torch.linalg.qr(blocks)
    return rotations * triangles.diagonal(dim1=-2, dim2=-1).sign()[..., None, :]


def _root(gram: Tensor) -> Tensor:
    """W (P, P) with `W^T W = (gram + lambda I)^-1`."""
    identity = torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    factor = torch.linalg.cholesky(gram + RIDGE * identity)
    return torch.linalg.solve_triangular(factor, identity, upper=False)


def _surprise(squared: Tensor, aleatoric: Tensor, spread: Tensor) -> Tensor:
    """(C,) negative log-likelihood, up to a constant, of squared residuals (n, K) at each candidate of c."""
    variances = (aleatoric + scale * spread for scale in SCALES.to(squared.device))  # one at a time: each is (n, K)
    return torch.stack([0.5 * (squared / variance + variance.log()).sum() for variance in variances]).to(SCALES.device)


def quantile(values: Tensor, probability: float) -> Tensor:
    """Quantile of any number of values; `torch.quantile` takes 16 million."""
    rank = max(1, round(probability * len(values)))
    return values.kthvalue(rank).values
