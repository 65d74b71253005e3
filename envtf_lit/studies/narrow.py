"""The study `envtf narrow`: does what is learned from the log of a machine that was held back harm the machine?

`et_cql` learns from each log as a user without a simulator would have it: a file, `task: null`, the defaults. The
policy that it publishes, and the clone that it began from, then run in the simulator that the log came from. Asked is
at least 80 % of the mean recorded return, and 95 % of the clone's, from every training seed; and that the truth lies in
the range that was promised.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from envtf_lit.agents.et_cql import ETCQLOptions
from envtf_lit.agents.trust_levels import CLONE, TrustLevel
from envtf_lit.data.options import DownloadOptions
from envtf_lit.data.sources.files import load_dataset, save_dataset
from envtf_lit.devices import pick_device
from envtf_lit.errors import UserError
from envtf_lit.evaluation.horizon import horizon_report
from envtf_lit.evaluation.metrics import held_out_metrics
from envtf_lit.evaluation.offline import evaluate_offline
from envtf_lit.evaluation.promises import kept, promised_range, read_frontier
from envtf_lit.files import read_json, write_json, write_text
from envtf_lit.pipeline.download import download
from envtf_lit.pipeline.generate_rollouts import generate_rollouts
from envtf_lit.pipeline.params import Params, check_rules
from envtf_lit.pipeline.stage import DATASET, POLICIES, WORLD_MODELS, rollouts_file
from envtf_lit.pipeline.train_model import train_model
from envtf_lit.pipeline.train_policy import train_policy
from envtf_lit.pipeline.yaml import dump_params
from envtf_lit.policy import load_policy
from envtf_lit.results import claim
from envtf_lit.robots.returns import evaluate_policy
from envtf_lit.studies.machine import facts
from envtf_lit.studies.narrow_logs import EPISODES, MACHINES, Machine, make_log, simulator
from envtf_lit.studies.suite import cached_result
from envtf_lit.training import run_folder
from envtf_lit.world_models.forecast import Scale, whole_episodes
from envtf_lit.world_models.store import load_world_model

WORK = Path(".envtf/narrow")  # where logs, models and what is measured are kept unless told otherwise
MARK = "narrow.seeds"
OF_RECORDED, OF_CLONE = 0.8, 0.95  # shares of those returns below which a policy has done harm
ALGORITHM = "et_cql"  # the section of the options that is tried; `bc` acts in the first rollouts
LOG, FACTS = "log.npz", "machine.json"


@dataclass(frozen=True)
class NarrowOptions:
    """The amounts.

    Attributes:
        seeds: of training, 0, 1, …; all learn from the same log, in the same world model.
        episodes: in the true simulator, of each policy.
        recorded: episodes of each log.
        steps: of a recorded episode, at most.
    """

    seeds: int = 5
    episodes: int = 10
    recorded: int = EPISODES
    steps: int = 1_000


def run_narrow(
    out: Path,
    *,
    params: Params,
    machines: Mapping[str, Machine] = MACHINES,
    trust: TrustLevel = "default",
    options: NarrowOptions,
    work: Path = WORK,
    progress: bool = True,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Trains on each log and scores in its simulator; what an interrupted call has finished is kept below `work`.

    Args:
        out: JSON file to write after each policy; a table lies beside it, as `.md`.
        params: sizes and budgets; its sections `et_cql` and `bc` are what is trained.
        machines: by name, see `MACHINES`.
        trust: level of trust.
        options: the amounts.
        work: folder of logs, models and what is measured; what lies there of the same options is used again.
        progress: shows bars.
        report: called with a line for each policy.

    Returns:
        What the file holds: by machine and seed what `_Project.finding` says, options, and the computer.

    Raises:
        UserError: something else lies at `out`, or the options have no `et_cql` that knows trust.
    """
    tried = params.train_policy.get(ALGORITHM)
    if not isinstance(tried, ETCQLOptions):
        raise UserError(f"train_policy.{ALGORITHM} does not know trust: give it `algorithm: {ALGORITHM}`.")
    claim(out, MARK, [out.with_suffix(".md")])
    torch.set_num_threads(params.threads)
    result: dict[str, Any] = {f"narrow.{name}": value for name, value in asdict(options).items()}
    result |= {"narrow.trust": trust} | {f"computer.{k}": v for k, v in facts(pick_device(), params.precision).items()}
    for name, machine in machines.items():
        project = _Project(name, machine, params, replace(tried, trust=trust), options, work, progress)
        project.prepare()
        result |= {f"{name}.{key}": value for key, value in project.known.items()}
        for seed in range(options.seeds):
            found = project.finding(seed)
            result |= {f"{name}.seed_{seed}.{key}": value for key, value in found.items()}
            write_json(out, result)
            write_text(out.with_suffix(".md"), page(result))
            report(f"{name}, seed {seed}: {_cells(found)}")
    return result


class _Project:
    """One machine's log, and what was learned from it: a folder as the pipeline's stages make it.

    Args:
        name: of the machine.
        machine: which.
        params: of the stages.
        tried: options of the policies.
        options: the amounts.
        work: parent of the folder, which is named by all of these.
        progress: shows bars.
    """

    def __init__(
        self,
        name: str,
        machine: Machine,
        params: Params,
        tried: ETCQLOptions,
        options: NarrowOptions,
        work: Path,
        progress: bool,
    ) -> None:
        settings = {"machine": asdict(machine), "recorded": options.recorded, "steps": options.steps}
        policies = {"bc": params.train_policy["bc"], ALGORITHM: tried}
        params = replace(params, task=None, seed=0, download=DownloadOptions("file", LOG), train_policy=policies)
        self.home = work / run_folder(work, name, settings | {"params": dump_params(params)}, []).name
        self.machine, self.options, self.progress = machine, options, progress
        own = DownloadOptions("file", str(self.home / LOG))
        self.params = replace(params, download=own)
        check_rules(self.params)
        self.world_model = self.home / WORLD_MODELS / tried.world_model

    @property
    def known(self) -> dict[str, Any]:
        """Of the machine: `recorded_mean`, mean return of its log's episodes, and `speed_limit`, m/s."""
        return read_json(self.home / FACTS)

    def prepare(self) -> None:
        """Log, dataset, world model, its first rollouts: what all seeds have in common."""
        params, home, shown = self.params, self.home, self.progress
        _unless(home / LOG, self._record)
        _unless(home / DATASET, lambda: download(params, home, progress=shown))
        _unless(self.world_model, lambda: train_model(params, home, name=self.world_model.name, progress=shown))
        _unless(home / POLICIES / "bc", lambda: train_policy(params, home, name="bc", progress=shown))
        rollouts = rollouts_file(home, self.world_model.name)
        _unless(rollouts, lambda: generate_rollouts(params, home, name=self.world_model.name, progress=shown))

    def _record(self) -> None:
        log, limit = make_log(self.machine, episodes=self.options.recorded, steps=self.options.steps)
        write_json(self.home / FACTS, {"recorded_mean": float(log.episode_returns.mean()), "speed_limit": limit})
        save_dataset(log, self.home / LOG)

    def finding(self, seed: int) -> dict[str, Any]:
        """What a training seed's policy earns, beside its clone, the record and its promise.

        Returns:
            `return_mean`, `return_std`, `clone_return_mean`, in the true simulator; the promised range, `promised_low`
            and `promised_high`, and `promise_held`, whether the first lies in it; `update` and `excess` of the
            published actor (0: the clone); `of_recorded` and `of_clone`, shares; `harmless`, whether they suffice.
        """
        name = f"seed_{seed}"
        folder = self.home / POLICIES / name
        params = replace(self.params, seed=seed, train_policy=self._sections(name))
        _unless(folder, lambda: train_policy(params, self.home, name=name, progress=self.progress))
        frontier = read_frontier(folder)
        assert frontier is not None
        row, promise = kept(frontier), promised_range(kept(frontier), self._held_out())
        key = {"episodes": self.options.episodes, "limit": self.known["speed_limit"]}
        found = cached_result(self.home, f"score_{name}", key, [folder], lambda: self._score(folder))
        earned, clone, recorded = found["return_mean"], found["clone_return_mean"], self.known["recorded_mean"]
        return found | {
            "promised_low": promise.low,
            "promised_high": promise.high,
            "promise_held": earned in promise,
            "update": int(row["update"]),
            "excess": row["excess"],
            "of_recorded": earned / recorded,
            "of_clone": earned / clone,
            "harmless": bool(_enough(earned, recorded, OF_RECORDED) and _enough(earned, clone, OF_CLONE)),
        }

    def _sections(self, name: str) -> dict[str, Any]:
        """The policies under their folders' names."""
        policies = self.params.train_policy
        return {"bc": policies["bc"], name: policies[ALGORITHM]}

    def _held_out(self) -> dict[str, float]:
        """What the world model makes of the held-out episode that it was not chosen by."""

        def measure() -> dict[str, float]:
            training, held_out = load_dataset(self.home / DATASET).split()
            episodes = whole_episodes(held_out.validation_and_test()[1], self.params.evaluate.trajectories, seed=0)
            model = load_world_model(self.world_model)
            report = horizon_report(model, episodes, Scale.of(training))
            return held_out_metrics(evaluate_offline(model, {}, report, training))

        return cached_result(self.home, "held_out", {}, [self.world_model, self.home / DATASET], measure)

    def _score(self, folder: Path) -> dict[str, float]:
        """Returns of a policy and of its clone in the true simulator, from the same starts."""
        robot = simulator(self.machine, self.known["speed_limit"])
        robot = replace(robot, max_episode_steps=self.options.steps)
        episodes, shown = self.options.episodes, self.progress
        ours, clone = (
            evaluate_policy(load_policy(place), robot, episodes=episodes, seed=0, progress=shown).returns
            for place in (folder, folder / CLONE)
        )
        return {
            "return_mean": float(ours.mean()),
            "return_std": float(ours.std()),
            "clone_return_mean": float(clone.mean()),
        }


def _unless(product: Path, work: Callable[[], object]) -> None:
    """Does a piece of work whose product is not there; each is written whole or not at all."""
    if not product.exists():
        work()


def _enough(earned: float, reference: float, share: float) -> bool:
    """Whether no more than what is left of the share is lost, of returns of either sign."""
    return earned >= reference - (1.0 - share) * abs(reference)


def page(result: Mapping[str, Any]) -> str:
    """The result as Markdown: a row for each log, and one for each policy."""
    head = ["log", "recorded", "seeds", "of the recorded: mean, worst", "of the clone: mean, worst", "harmless", "held"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    one = [f"| log | seed | {_HEAD} |", "|---" * (2 + _HEAD.count("|") + 1) + "|"]
    for name, found in _by_machine(result):
        shares = {key: np.array([each[key] for each in found]) for key in ("of_recorded", "of_clone")}
        cells = [name, f"{result[f'{name}.recorded_mean']:,.0f}", str(len(found))]
        cells += [f"{values.mean():.0%}, {values.min():.0%}" for values in shares.values()]
        cells += [f"{sum(each[key] for each in found)} of {len(found)}" for key in ("harmless", "promise_held")]
        lines.append(f"| {' | '.join(cells)} |")
        one += [f"| {name} | {seed} | {_cells(each)} |" for seed, each in enumerate(found)]
    return "\n".join([*lines, "", *one, ""])


_HEAD = "published earned | of the recorded | of the clone | promised | held | published"


def _cells(found: Mapping[str, Any]) -> str:
    """What matters of one policy, as cells of a table under `_HEAD`."""
    actor = f"after update {found['update']}, {found['excess']:.2f} nats" if found["update"] else "the clone"
    cells = [
        f"{found['return_mean']:,.0f} ± {found['return_std']:,.0f}",
        f"{found['of_recorded']:.0%}",
        f"{found['of_clone']:.0%}{'' if found['harmless'] else ' **harm**'}",
        f"{found['promised_low']:,.0f} to {found['promised_high']:,.0f}",
        "yes" if found["promise_held"] else "**no**",
        actor,
    ]
    return " | ".join(cells)


def _by_machine(result: Mapping[str, Any]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Each machine's name, and the findings of its seeds so far."""
    for name in [key.removesuffix(".recorded_mean") for key in result if key.endswith(".recorded_mean")]:
        found: dict[int, dict[str, Any]] = {}
        for key, value in result.items():
            if key.startswith(f"{name}.seed_"):
                seed, _, what = key.removeprefix(f"{name}.seed_").partition(".")
                found.setdefault(int(seed), {})[what] = value
        if found:
            yield name, [found[seed] for seed in sorted(found)]
