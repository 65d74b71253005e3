"""The benchmark `envtf bench agents`: updates per second of our agents on a CPU, beside d3rlpy's.

Both sides learn from one log of noise, with three hidden layers of 256 units, 256 rows a batch and, of CQL, ten sampled
actions of each kind; each by its own training loop, all of them in turn. What is measured is the loop from its first
update to its last, drawing of rows included: with one thread in seconds of its process, which other work on the machine
does not stretch, with more in those of the clock on the wall.
"""

import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback

from envtf_lit.agents.agent import Agent
from envtf_lit.agents.options import PolicyOptions
from envtf_lit.agents.phases import follow
from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.critics import StackedCritics
from envtf_lit.data.datamodules import TransitionData
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.options import UPDATES_PER_STEP
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.devices import resolved
from envtf_lit.errors import UserError
from envtf_lit.files import write_json
from envtf_lit.options.schema import Precision
from envtf_lit.pipeline.train_policy import transition_data
from envtf_lit.results import claim
from envtf_lit.studies import d3rlpy_worker
from envtf_lit.studies.machine import facts, in_turns, ratio, typical
from envtf_lit.training import LIGHTNING

CPU = torch.device("cpu")
ROWS, LENGTH, S, A = 10_000, 500, 11, 3  # of the log: its dimensions are Hopper's
SEEDS = 3  # that a stacked pass holds
NETS: dict[str, Any] = dict(
    hidden=(256, 256, 256),
    layer_norm=False,
    batch_size=256,
    discount=0.99,
    n_step=1,
    return_temperature=None,
    normalise_returns=False,
    warm_start=0.0,
    actor_schedule="constant",
    actor_average=1.0,
)
OPTIONS: dict[str, dict[str, Any]] = {  # as `d3rlpy_worker.configs`
    "cql": dict(sampled_actions=10, cql_weight=5.0, clone_weight=0.0),
    "iql": dict(),
    "td3_bc": dict(),
    "rebrac": dict(actor_penalty=0.01, critic_penalty=0.01),
}
COST = dict(cql=10, iql=1, td3_bc=1, rebrac=1)  # of an update, roughly, in updates of the cheapest: all turns are alike


def bench_agents(
    out: Path | None = None, *, d3rlpy: Path | None = None, updates: int = 100, rounds: int = 5, threads: int = 1
) -> dict[str, Any]:
    """Measures our agents' updates per second, and d3rlpy's.

    Args:
        out: JSON file of the result; None writes none.
        d3rlpy: Python of an environment that has d3rlpy; None leaves its side out, and the ratios null.
        updates: of an algorithm in each round; a tenth of CQL's with ten sampled actions. Multiples of 100.
        rounds: in which all sides take turns; medians are reported.
        threads: of both sides.

    Returns:
        Flat; `docs/bench.md` explains each.

    Raises:
        UserError: `out` is there and no such result, `updates` is no multiple of 100, or `d3rlpy` is no Python with
            d3rlpy.
    """
    if out is not None:
        claim(out, "default_updates_per_second")
    if updates % (UPDATES_PER_STEP * COST["cql"]):
        raise UserError(f"--updates is {updates}: take a multiple of {UPDATES_PER_STEP * COST['cql']}.")
    torch.set_num_threads(threads)
    counts = {name: updates // cost for name, cost in COST.items()}
    with tempfile.TemporaryDirectory() as folder:
        log = _write_log(Path(folder))
        both: tuple[Precision, ...] = ("fp32", "bf16")
        sides = {f"{name}_{one}": _ours(log, name, counts[name], one) for name in OPTIONS for one in both}
        sides["default"] = _ours(log, "default", updates, "auto")
        sides["bare"] = _bare(log, "default", updates, "auto")
        sides |= _stacks(NETS["hidden"], NETS["batch_size"])
        with their_side(d3rlpy, log.with_suffix(".npz"), threads) as (versions, run):
            if run is not None:
                sides |= {f"{name}_d3rlpy": _theirs(run, name, counts[name]) for name in OPTIONS}
            timings = in_turns(sides, rounds)
    counts |= {"default": updates, "bare": updates}
    result = _ratios(timings, their=bool(versions)) | _rates(timings, counts)
    result |= dict(updates=updates, rounds=rounds) | facts(CPU, "auto") | versions
    if out is not None:
        write_json(out, result)
    return result


def _ratios(timings: list[dict[str, float]], *, their: bool) -> dict[str, float | None]:
    def against(name: str, precision: Precision = "fp32") -> float | None:  # d3rlpy has no other than fp32
        return ratio(timings, f"{name}_d3rlpy", f"{name}_{precision}") if their else None

    return {
        "cql_vs_d3rlpy_fp32": against("cql"),
        "cql_vs_d3rlpy_bf16": against("cql", "bf16"),
        **{f"{name}_vs_d3rlpy": against(name, resolved("auto", CPU)) for name in ("iql", "td3_bc", "rebrac")},
        **{f"{name}_vs_d3rlpy_fp32": against(name) for name in ("iql", "td3_bc", "rebrac")},
        "stacked_seeds_ratio": ratio(timings, "one_after_another", "stacked"),
        "lightning_share": 1.0 - ratio(timings, "bare", "default"),
    }


def _rates(timings: list[dict[str, float]], counts: dict[str, int]) -> dict[str, float]:
    of = {side: next((name for name in counts if side.startswith(name)), None) for side in timings[0]}
    return {f"{side}_updates_per_second": counts[name] / typical(timings, side) for side, name in of.items() if name}


def _write_log(folder: Path) -> Path:
    """A log of noise as HDF5 and, for the other side, as NPZ beside it."""
    rng, path = np.random.default_rng(0), folder / "log.h5"
    ends = np.arange(1, ROWS + 1) % LENGTH == 0
    dataset = OfflineDataset(
        observations=rng.normal(size=(ROWS, S)).astype(np.float32),
        actions=rng.uniform(-1, 1, (ROWS, A)).astype(np.float32),
        rewards=rng.normal(size=ROWS).astype(np.float32),
        next_observations=rng.normal(size=(ROWS, S)).astype(np.float32),
        terminated=np.zeros(ROWS, bool),
        truncated=ends,
        episode_starts=np.arange(0, ROWS, LENGTH),
        action_low=-np.ones(A, np.float32),
        action_high=np.ones(A, np.float32),
    )
    save_dataset(dataset, path)
    write_plain(dataset, path.with_suffix(".npz"))
    return path


def write_plain(dataset: OfflineDataset, path: Path, *, scaled: bool = False) -> None:
    """The columns that the other side reads; observations z-scored if wanted, as our networks do themselves."""
    flags = {"terminals": dataset.terminated, "timeouts": dataset.truncated & ~dataset.terminated}
    wide = {name: np.asarray(getattr(dataset, name)[:]) for name in ("observations", "actions", "rewards")}
    if scaled:
        mean, std = (scale.numpy() for scale in dataset.observation_scale())
        wide["observations"] = (wide["observations"] - mean) / std
    np.savez(path, allow_pickle=False, **wide, **{name: flag.astype(np.float32) for name, flag in flags.items()})


def agent_on(log: Path, name: str, updates: int, seed: int = 0) -> tuple[Agent, TransitionData]:
    """An algorithm at the comparison's settings, or CQL at our own defaults, and its data; one epoch of updates."""
    cls = ALGORITHMS["cql" if name == "default" else name]
    given = {} if name == "default" else NETS | OPTIONS[name]
    options: PolicyOptions = cls.Options(**given, updates=updates, updates_per_epoch=updates)
    data = transition_data(log, options, seed=seed)
    space = dict(action_low=data.action_low, action_high=data.action_high)
    torch.manual_seed(seed)
    return cls(data.observation_dim, data.action_dim, options, seed=seed, **space), data


def fit(agent: Agent, data: TransitionData, precision: Precision) -> float:
    """Seconds of one epoch in Lightning's loop, from its first batch to its last."""
    clock = _Clock()
    trainer = L.Trainer(
        max_epochs=1,
        precision=LIGHTNING[resolved(precision, CPU)],
        accelerator="cpu",
        callbacks=[clock],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
        limit_val_batches=0,
    )
    trainer.fit(agent, datamodule=data)
    return clock.seconds


class _Clock(Callback):
    """Times an epoch."""

    seconds: float

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.begin = d3rlpy_worker.now(torch.get_num_threads())

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.seconds = d3rlpy_worker.now(torch.get_num_threads()) - self.begin


def _timed(action: Callable[[], None]) -> float:
    threads = torch.get_num_threads()
    begin = d3rlpy_worker.now(threads)
    action()
    return d3rlpy_worker.now(threads) - begin


def _ours(log: Path, name: str, updates: int, precision: Precision) -> Callable[[], float]:
    return lambda: fit(*agent_on(log, name, updates), precision)


def _bare(log: Path, name: str, updates: int, precision: Precision) -> Callable[[], float]:
    """The same updates in a plain loop over the same batches, without Lightning."""

    def run() -> float:
        agent, data = agent_on(log, name, updates)
        plain: Any = agent
        optimizers = agent.configure_optimizers()
        plain.optimizers = lambda **_: optimizers
        plain.manual_backward = lambda loss: loss.backward()
        plain.generator, plain.update_index, plain.logged = torch.Generator().manual_seed(0), 0, {}
        plain.clones = True
        batches = data.train_dataloader()

        def loop() -> None:
            with torch.autocast("cpu", torch.bfloat16, enabled=resolved(precision, CPU) == "bf16", cache_enabled=False):
                for index, batch in enumerate(batches):
                    agent.training_step(batch, index)

        return _timed(loop)

    return run


def _stacks(hidden: tuple[int, ...], batch: int) -> dict[str, Callable[[], float]]:
    """Updates of several seeds' critics, which are most of any agent's: in one stack, and one after another."""

    def side(stacks: int, size: int) -> Callable[[], float]:
        critics = [StackedCritics(S, A, n=2 * size, hidden=hidden, layer_norm=False) for _ in range(stacks)]
        targets = [StackedCritics(S, A, n=2 * size, hidden=hidden, layer_norm=False) for _ in range(stacks)]
        optimizers = [torch.optim.Adam(one.parameters(), lr=3e-4, fused=True) for one in critics]
        observation, action = torch.randn(batch, S), torch.rand(batch, A)

        def run() -> None:
            for _ in range(20):
                for one, target, optimizer in zip(critics, targets, optimizers, strict=True):
                    optimizer.zero_grad()
                    one(observation, action).square().mean(1).sum().backward()
                    optimizer.step()
                    follow(target, one, 0.005)

        return lambda: _timed(run)

    return {"stacked": side(1, SEEDS), "one_after_another": side(SEEDS, 1)}


Run = Callable[[dict[str, Any]], dict[str, float]]


@contextmanager
def their_side(python: Path | None, log: Path, threads: int) -> Iterator[tuple[dict[str, str], Run | None]]:
    """A process of d3rlpy's: its versions, and what gives it a job (`d3rlpy_worker`); none without a Python.

    Raises:
        UserError: that Python is none, or has no d3rlpy.
    """
    if python is None:
        yield {}, None
        return
    words = [str(python), d3rlpy_worker.__file__, str(log), str(threads)]
    try:
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=log.parent
        )
    except OSError as error:
        raise UserError(
            f"{python} cannot be run ({error.strerror}): give the Python of d3rlpy's environment."
        ) from None
    with process:
        assert process.stdin is not None and process.stdout is not None
        stdin, stdout = process.stdin, process.stdout
        try:
            first = stdout.readline()
            if not first:
                raise UserError(
                    f"{python} has no d3rlpy that runs: install it there with {python} -m pip install "
                    "-r benchmarks/d3rlpy/requirements.txt."
                )

            def run(job: dict[str, Any]) -> dict[str, float]:
                stdin.write(json.dumps(job) + "\n")
                stdin.flush()
                return json.loads(stdout.readline())

            yield {f"their_{name}": version for name, version in json.loads(first).items()}, run
        finally:
            stdin.close()


def _theirs(run: Run, name: str, updates: int) -> Callable[[], float]:
    return lambda: run({"name": name, "seed": 0, "updates": updates})["seconds"]
