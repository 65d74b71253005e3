"""One step of a world model as a function of tensors alone, for export: no state beside its arguments, no branches.

The transformer's ring of keys and values has a fixed shape, and its clock is a tensor: which slot a token goes to, and
which slots it may look at, are computed from it. Each row has a clock of its own, so that rollouts whose histories
differ in length step together; rotary positions are relative, so that nothing depends on where a clock began.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from envtf_lit.errors import UserError
from envtf_lit.world_models.attention import Block, rotate, rotation
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import Prediction
from envtf_lit.world_models.transformer import EnvironmentTransformer

NEXT = "next_"  # before the name of what is carried on


class StepGraph(nn.Module, ABC):
    """A world model's step, `forward(*inputs) -> outputs`, with names for all of them.

    Every input and output has the batch as its first axis. Of the outputs, `next_X` is the next step's input X.

    Args:
        model: in eval mode.

    Attributes:
        inputs: names of the arguments of `forward`, in order.
        outputs: names of what it returns, in order.
    """

    inputs: ClassVar[tuple[str, ...]]

    def __init__(self, model: EnvironmentTransformer | EnsembleDynamics, *, epistemic: bool, novelty: bool) -> None:
        super().__init__()
        self.observation_dim, self.action_dim = model.observation_dim, model.action_dim
        predicted = ("next_observation", "reward", "mean", "aleatoric", "uncertainty")
        self.outputs = (*predicted, *("epistemic",) * epistemic, *("novelty",) * novelty)

    @abstractmethod
    def start(self, rows: int) -> dict[str, Tensor]:
        """The inputs of the first step of so many rollouts beside observation, action and noise."""

    def named(self, prediction: Prediction) -> tuple[Tensor, ...]:
        """What is predicted, in the order of `outputs`."""
        values = {
            "next_observation": prediction.observation,
            "reward": prediction.reward,
            "mean": prediction.mean,
            "aleatoric": prediction.aleatoric,
            "uncertainty": prediction.uncertainty,
            "epistemic": prediction.epistemic,
            "novelty": prediction.novelty,
        }
        return tuple(value for name in self.outputs if (value := values.get(name)) is not None)


class TransformerStep(StepGraph):
    """The Environment Transformer's: `observation`, `action`, `noise`, `cache` and `clock` to what comes next.

    Shapes: observation (B, S), action (B, A), noise (B, S + 1), cache (B, layers, 2, H, context, d) of keys and values,
    clock (B,) int64, the tokens that each row has had. Zero noise gives the mean, standard normal noise a sample.
    """

    inputs = ("observation", "action", "noise", "cache", "clock")

    def __init__(self, model: EnvironmentTransformer) -> None:
        laplace = model.laplace is not None
        super().__init__(model, epistemic=laplace or model.has_epistemic_head, novelty=laplace)
        self.model, self.options = model, model.options
        self.outputs += ("next_cache", "next_clock")

    def start(self, rows: int) -> dict[str, Tensor]:
        """See `StepGraph.start`: an empty ring, and clocks at zero."""
        o = self.options
        ring = torch.zeros(rows, o.layers, 2, o.heads, o.context, o.width // o.heads)
        return {"cache": ring, "clock": torch.zeros(rows, dtype=torch.int64)}

    def forward(
        self, observation: Tensor, action: Tensor, noise: Tensor, cache: Tensor, clock: Tensor
    ) -> tuple[Tensor, ...]:
        """One token for each row; see the class for shapes."""
        slot = torch.arange(self.options.context, device=clock.device)
        here = slot == (clock % self.options.context)[:, None]  # (B, C) where the token goes
        visible = slot <= clock[:, None]  # (B, C) slots that hold a token, this one among them
        cos_sin = rotation(clock, self.options.width // self.options.heads)  # (B, d)
        token = self.model.normaliser.token(observation, action)
        x = self.model.embed(token)
        rings = []
        for number, block in enumerate(self.model.blocks):
            assert isinstance(block, Block)
            x, ring = _advance(block, x, cache[:, number], here, visible, cos_sin)
            rings.append(ring)
        prediction = self.model.predict(self.model.norm(x), token, observation, noise=noise)
        return *self.named(prediction), torch.stack(rings, 1), clock + 1


def _advance(
    block: Block, x: Tensor, ring: Tensor, here: Tensor, visible: Tensor, cos_sin: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """A block's output (B, D) and its ring (B, 2, H, C, d), the token (B, D) in its slot."""
    attention = block.attention
    _, _, heads, _, width = ring.shape
    qkv = attention.qkv(block.attention_norm(x)).view(-1, 3, heads, width)
    cos, sin = cos_sin
    q, k = rotate(qkv[:, :2], (cos[:, None, None], sin[:, None, None])).unbind(1)  # (B, H, d)
    written = torch.stack([k, qkv[:, 2]], 1)[:, :, :, None]  # (B, 2, H, 1, d)
    ring = torch.where(here[:, None, None, :, None], written, ring)
    keys, values = ring.unbind(1)  # (B, H, C, d)
    score = q[:, :, None] @ keys.transpose(-2, -1) * width**-0.5  # (B, H, 1, C)
    weight = score.masked_fill(~visible[:, None, None], float("-inf")).softmax(-1)
    return block.finish(x, attention.out((weight @ values).flatten(1))), ring


class EnsembleStep(StepGraph):
    """The ensemble's, which carries nothing on: `observation`, `action`, `noise` and `elite` to what comes next.

    Shapes: observation (B, S), action (B, A), noise (B, S + 1), elite (B,) int64, which elite each row follows, from 0
    to E - 1, or -1 for the mean of all. Zero noise gives the mean; a draw takes a random elite and standard normal
    noise.
    """

    inputs = ("observation", "action", "noise", "elite")

    def __init__(self, model: EnsembleDynamics) -> None:
        super().__init__(model, epistemic=model.members > 1, novelty=model.members > 1)
        self.model = model

    def start(self, rows: int) -> dict[str, Tensor]:
        """See `StepGraph.start`: rows that follow the mean of all elites."""
        return {"elite": torch.full((rows,), -1)}

    def forward(self, observation: Tensor, action: Tensor, noise: Tensor, elite: Tensor) -> tuple[Tensor, ...]:
        """One step of each row; see the class for shapes."""

        def value(means: Tensor, log_variances: Tensor) -> Tensor:
            index = elite.clamp(min=0)[None, :, None].expand(1, *means.shape[1:])
            mean, log_variance = (x.gather(0, index)[0] for x in (means, log_variances))
            mean = torch.where(elite[:, None] < 0, means.mean(0), mean)
            return mean + torch.exp(0.5 * log_variance) * noise

        return self.named(self.model.predict(observation, action, value))


def step_graph(model: nn.Module) -> StepGraph:
    """The step of a world model as a function.

    Raises:
        UserError: a kind that has none.
    """
    if isinstance(model, EnvironmentTransformer):
        return TransformerStep(model)
    if isinstance(model, EnsembleDynamics):
        return EnsembleStep(model)
    raise UserError(f"A {type(model).__name__} cannot be exported: give an EnvironmentTransformer or an ensemble.")
