"""Policies and world models as files that run elsewhere: ONNX (.onnx), and `torch.export` (.pt2).

What is written is compared with PyTorch before it takes its place, by what will run it. Dimensions, limits and versions
lie in the file: `metadata_props` of ONNX, `metadata.json` of torch.export's archive.
"""

import contextlib
import io
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from envtf_lit.actors import Actor, DeterministicActor, GaussianActor, TanhGaussianActor, kind_of
from envtf_lit.errors import UserError, missing_extra
from envtf_lit.files import replacing
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.step_graph import NEXT, StepGraph, step_graph
from envtf_lit.world_models.transformer import EnvironmentTransformer

ONNX, PT2 = ".onnx", ".pt2"
TOLERANCE = 1e-5  # of a value, or of its spread in the data where that is more
ROWS = 5  # of the comparison; the batch is free in what is written
BEYOND = 50  # steps of the comparison past the context's length
MOST_ROWS = 2**20

Named = dict[str, Tensor]
Run = Callable[[Named], Named]


class PolicyGraph(nn.Module):
    """A policy as a function of tensors: observation (B, S) and noise (B, A) to action, mean and log_std, each (B, A).

    The action is in the environment's range. Mean and log standard deviation are of the Gaussian that it is drawn from:
    before the tanh of a `tanh_gaussian` actor, in shares of the range, [-1, 1], of the others; a deterministic one's
    log_std is -inf. Zero noise gives the action of `act`, standard normal noise a draw.
    """

    inputs, outputs = ("observation", "noise"), ("action", "mean", "log_std")

    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See the class."""
        actor = self.actor
        if isinstance(actor, DeterministicActor):
            mean = torch.tanh(actor.outputs(observation))
            log_std = torch.full_like(mean, float("-inf"))
        else:
            mean, log_std = actor(observation)
            log_std = log_std.expand_as(mean)
        drawn = mean + log_std.exp() * noise
        squashed = torch.tanh(drawn) if isinstance(actor, TanhGaussianActor) else drawn.clamp(-1.0, 1.0)
        low, high = actor.action_low, actor.action_high
        return low + 0.5 * (squashed + 1.0) * (high - low), mean, log_std


@dataclass(frozen=True)
class _Graph:
    """What is written, and what it is compared with.

    Attributes:
        module: whose `forward` takes tensors with a batch axis, and returns such.
        inputs, outputs: their names.
        examples: of the inputs.
        metadata: about it, ready for JSON.
        compare: runs the written file, and raises UserError where it differs from PyTorch.
    """

    module: nn.Module
    inputs: Sequence[str]
    outputs: Sequence[str]
    examples: Named
    metadata: dict[str, Any]
    compare: Callable[[Run], None]


def export_policy(policy: Actor, out: str | Path) -> None:
    """Writes a policy as a function of observation and noise; see `PolicyGraph`.

    Args:
        policy: of any kind.
        out: a new file ending in .onnx or .pt2.

    Raises:
        UserError: another kind of policy, another ending, a file that is there already, a missing extra `export`, or a
            result that differs from PyTorch by more than 1e-5 of a value or of the range. Nothing half-written stays.
    """
    if not isinstance(policy, TanhGaussianActor | GaussianActor | DeterministicActor):
        raise UserError(f"A {type(policy).__name__} cannot be exported: give a policy that was trained and saved.")
    graph, limits = PolicyGraph(policy).eval(), (policy.action_low, policy.action_high)
    generator = torch.Generator().manual_seed(0)
    S, A = len(policy.observation_mean), len(policy.action_low)

    def rows(count: int) -> Named:
        z = 2.0 * torch.randn(count, S, generator=generator)
        noise = torch.randn(count, A, generator=generator)
        return {"observation": policy.observation_mean + policy.observation_std * z, "noise": noise}

    def compare(run: Run) -> None:
        for count in (1, ROWS):
            inputs = rows(count)
            for noise in (inputs["noise"], torch.zeros(count, A)):
                expected = dict(zip(graph.outputs, graph(inputs["observation"], noise), strict=True))
                if not noise.any():
                    expected["action"] = policy.act(inputs["observation"])
                found = run(inputs | {"noise": noise})
                _compare(expected, found, {"action": limits[1] - limits[0]}, out)

    metadata = dict(
        kind=kind_of(policy),
        observation_dim=S,
        action_dim=A,
        action_low=limits[0].tolist(),
        action_high=limits[1].tolist(),
        observation_mean=policy.observation_mean.tolist(),
    )
    with torch.no_grad():
        _write(_Graph(graph, graph.inputs, graph.outputs, rows(ROWS), metadata, compare), Path(out))


def export_world_model(model: EnvironmentTransformer | EnsembleDynamics, out: str | Path) -> None:
    """Writes one step of a world model as a function of all that it needs; see `world_models.step_graph`.

    Args:
        model: in eval mode, on the CPU.
        out: a new file ending in .onnx or .pt2.

    Raises:
        UserError: another kind of model, another ending, a file that is there already, a missing extra `export`, or a
            step that differs from PyTorch's, up to 50 past the context's length, by more than 1e-5 of a value or of its
            standard deviation in the data. Nothing half-written stays.
    """
    graph = step_graph(model).eval()
    ring = isinstance(model, EnvironmentTransformer)
    context = model.options.context if ring else 1
    metadata = dict(
        kind="environment_transformer" if ring else "ensemble_dynamics",
        observation_dim=model.observation_dim,
        action_dim=model.action_dim,
        context=context,
        arguments=model.arguments,
        observation_mean=model.normaliser.observation_mean.tolist(),
    )
    generator = torch.Generator().manual_seed(0)
    examples = _rows(model, generator) | {"noise": torch.zeros(ROWS, model.observation_dim + 1)} | graph.start(ROWS)

    def compare(run: Run) -> None:
        _compare_steps(model, graph, run, context + BEYOND, out)

    with torch.no_grad():
        _write(_Graph(graph, graph.inputs, graph.outputs, examples, metadata, compare), Path(out))


def _rows(model: EnvironmentTransformer | EnsembleDynamics, generator: torch.Generator) -> Named:
    """Pairs spread as those of the training data are."""
    scales = model.normaliser
    z = torch.randn(ROWS, model.observation_dim, generator=generator)
    a = torch.randn(ROWS, model.action_dim, generator=generator)
    observation, action = (
        scales.observation_mean + scales.observation_std * z,
        scales.action_mean + scales.action_std * a,
    )
    return {"observation": observation, "action": action}


def _compare_steps(
    model: EnvironmentTransformer | EnsembleDynamics, graph: StepGraph, run: Run, steps: int, out: str | Path
) -> None:
    """Runs both side by side, each on its own cache: `model.step` itself, and what was written."""
    generator = torch.Generator().manual_seed(1)
    world, scales = cast(WorldModel, model), model.normaliser
    spread = torch.cat([scales.observation_std, scales.target_std[-1:]])
    sizes = dict.fromkeys(("mean", "aleatoric", "epistemic"), spread)
    sizes |= {"next_observation": spread[:-1], "reward": spread[-1:]}
    begun = _rows(model, generator)
    empty = torch.zeros(ROWS, 0, model.action_dim)
    state = world.init(begun["observation"][:, None], empty, torch.ones(ROWS, dtype=torch.int64))
    carried = begun | {"noise": torch.zeros(ROWS, model.observation_dim + 1)} | graph.start(ROWS)
    for _ in range(steps):
        inputs = _rows(model, generator)
        state, prediction = world.step(world.observe(state, inputs["observation"]), inputs["action"])
        found = run(carried | inputs)
        expected = dict(zip(graph.outputs, graph.named(prediction), strict=False))
        _compare(expected, {name: found[name] for name in expected}, sizes, out)
        carried |= {name.removeprefix(NEXT): value for name, value in found.items() if name.startswith(NEXT)}
    carried["noise"] = torch.randn(ROWS, model.observation_dim + 1, generator=generator)
    drawn = dict(zip(graph.outputs, graph(*(carried[name] for name in graph.inputs)), strict=True))
    _compare(drawn, run(carried), sizes, out)


def _compare(expected: Named, found: Named, sizes: Named, out: str | Path) -> None:
    """Refuses outputs that differ by more than `TOLERANCE` of themselves or, if that is more, of their `sizes`."""
    for name, value in expected.items():
        near = torch.maximum(value.abs(), sizes.get(name, torch.ones(())))
        same = (value == found[name]) | ((value - found[name]).abs() <= TOLERANCE * near)
        if not same.all():
            worst = float(((value - found[name]).abs() / near)[~same].max())
            raise UserError(
                f"{out} was not written: its {name} differs from PyTorch's by {worst:.2g} of its size, where "
                f"{TOLERANCE:g} is allowed; try another version of torch or onnxruntime, or the other format."
            )


def _write(graph: _Graph, out: Path) -> None:
    if out.suffix not in (ONNX, PT2):
        raise UserError(f"{out} ends in {out.suffix!r}: name an exported file .onnx or .pt2.")
    if out.exists():
        raise UserError(f"{out} exists already: give the new file another name, or delete this one.")
    versions = {name: version(name) for name in ("envtf-lit", "torch")}
    metadata = {**graph.metadata, "inputs": list(graph.inputs), "outputs": list(graph.outputs), "versions": versions}
    write, load = (_write_onnx, _load_onnx) if out.suffix == ONNX else (_write_pt2, _load_pt2)
    if out.suffix == ONNX:
        _needed()
    with replacing(out) as temporary, _quiet():
        write(graph, metadata, temporary)
        graph.compare(load(graph, temporary))


def _program(graph: _Graph) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch", min=1, max=MOST_ROWS)
    arguments = tuple(graph.examples[name] for name in graph.inputs)
    return torch.export.export(graph.module, arguments, dynamic_shapes=tuple({0: batch} for _ in arguments))


def _write_pt2(graph: _Graph, metadata: dict[str, Any], path: Path) -> None:
    with path.open("wb") as stream:
        torch.export.save(_program(graph), stream, extra_files={"metadata.json": json.dumps(metadata)})


def _load_pt2(graph: _Graph, path: Path) -> Run:
    module = torch.export.load(io.BytesIO(path.read_bytes())).module()

    def run(inputs: Named) -> Named:
        values = module(*(inputs[name] for name in graph.inputs))
        return dict(zip(graph.outputs, values, strict=True))

    return run


def _needed() -> None:
    try:
        import onnxruntime  # noqa: F401  (both are asked for before long work)
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise missing_extra("ONNX needs more packages to write, and to compare with PyTorch", "export", error) from None


def _write_onnx(graph: _Graph, metadata: dict[str, Any], path: Path) -> None:
    program = torch.onnx.export(
        _program(graph),
        tuple(graph.examples[name] for name in graph.inputs),
        dynamo=True,
        input_names=graph.inputs,
        output_names=graph.outputs,
        external_data=False,
        verbose=False,
    )
    assert program is not None
    model = program.model
    ends = [*model.graph.inputs, *model.graph.outputs]
    for value in ends:
        assert value.shape is not None
        value.shape[0] = "batch"  # where torch has a number of its own
    for value in (value for node in model.graph for value in node.outputs if value not in ends):
        value.name = f"{value.name}_"  # torch's names, such as `mean`, may be those of outputs
    model.metadata_props.clear()
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in metadata.items()}
    model.metadata_props.update(texts)
    path.write_bytes(program.model_proto.SerializeToString())


def _load_onnx(graph: _Graph, path: Path) -> Run:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors alone
    session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])

    def run(inputs: Named) -> Named:
        values: Any = session.run(list(graph.outputs), {name: inputs[name].numpy() for name in graph.inputs})
        return {name: torch.from_numpy(value) for name, value in zip(graph.outputs, values, strict=True)}

    return run


def read_observations(path: Path, dimensions: int) -> np.ndarray:
    """Observations (S,) or (B, S) of a .npy file, as float32.

    Raises:
        UserError: it is missing or no array of numbers, has other dimensions, or holds what is not finite.
    """
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: write one with numpy.save.") from None
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path} is not a .npy file of numbers ({error}): write one with numpy.save.") from None
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
        raise UserError(f"{path} holds no array of numbers: write one with numpy.save.")
    if values.ndim not in (1, 2) or values.shape[-1] != dimensions or not values.size:
        wanted = f"({dimensions},) or (rows, {dimensions})"
        raise UserError(f"{path} has shape {values.shape}, and the policy wants {wanted}: give it such observations.")
    with np.errstate(over="ignore"):
        found = np.array(values, np.float32)
    if not np.isfinite(found).all():
        place = tuple(np.argwhere(~np.isfinite(found))[0].tolist())
        raise UserError(f"{path} holds {found[place]} at {place}, for which there is no action: mend the observation.")
    return found


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporter says of its own insides: of torch's older names, of packages that are not needed."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
