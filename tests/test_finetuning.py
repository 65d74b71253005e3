"""A world model that starts from another one: what is kept, what begins anew, and whose scales count."""

import pytest
import torch

from envtf_lit.errors import UserError
from envtf_lit.world_models.finetuning import start_from
from envtf_lit.world_models.transformer import EnvironmentTransformer

SMALL = dict(layers=2, heads=2, width=16, context=6)


def scaled(model: EnvironmentTransformer, seed: int) -> EnvironmentTransformer:
    """The same with a normaliser of its own."""
    generator = torch.Generator().manual_seed(seed)
    for name, buffer in model.normaliser.named_buffers():
        if name != "live":
            drawn = torch.rand(buffer.shape, generator=generator)
            buffer.copy_(0.5 + drawn if name.endswith("std") else drawn - 0.5)
    return model


@pytest.mark.parametrize("epistemic", ["laplace", "head"])
def test_a_model_that_starts_from_another_predicts_as_it_did_whatever_its_own_scale(epistemic):
    torch.manual_seed(0)
    base = scaled(EnvironmentTransformer(3, 2, **SMALL, epistemic=epistemic), 1)
    mine = scaled(EnvironmentTransformer(3, 2, **SMALL, epistemic=epistemic), 2)
    before = {name: buffer.clone() for name, buffer in mine.normaliser.named_buffers()}
    start_from(mine, base)
    assert all(torch.equal(buffer, before[name]) for name, buffer in mine.normaliser.named_buffers())
    observations, actions = torch.randn(4, 5, 3), torch.randn(4, 5, 2)
    outcomes, deviations = [], []
    for model in (base, mine):
        mean, log_variance, _ = model(observations, actions)
        outcomes.append(model.normaliser.outcome(observations, mean))
        deviations.append((0.5 * log_variance).exp() * model.normaliser.target_std)
    torch.testing.assert_close(outcomes[1], outcomes[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(deviations[1], deviations[0], rtol=2e-2, atol=0)  # up to the soft bounds


@pytest.mark.parametrize(
    ("S", "A", "kept"), [(3, 2, {"embed", "head"}), (3, 4, {"head"}), (4, 2, set()), (4, 1, set())]
)
def test_the_blocks_are_kept_and_projections_of_other_dimensions_begin_anew(S, A, kept):
    torch.manual_seed(0)
    base, mine = EnvironmentTransformer(3, 2, **SMALL), EnvironmentTransformer(S, A, **SMALL)
    fresh = {name: value.clone() for name, value in mine.state_dict().items()}
    start_from(mine, base)
    theirs = base.state_dict()
    for name, value in mine.named_parameters():
        taken_over = name.split(".")[0] in {"blocks", "norm"} | kept
        assert torch.equal(value, theirs[name] if taken_over else fresh[name]), name


def test_what_the_weights_mean_cannot_change():
    base = EnvironmentTransformer(3, 2, **SMALL)
    with pytest.raises(UserError, match="target is delta there and absolute here"):
        start_from(EnvironmentTransformer(3, 2, **SMALL, target="absolute"), base)
