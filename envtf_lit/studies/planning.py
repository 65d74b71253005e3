"""The study `envtf bench planning`: planners on Pendulum-v1, through a learned world model and through the true one.

The model is learned from random steps. Each family then plays the same episodes of the simulator twice: planning
through the model, and through the simulator's own equations. Returns are negative here, so that their ratio would
reward a worse model; what is compared is the gain over random actions:

    share = (R_learned - R_random) / (R_true - R_random)
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from envtf_lit.data.dataset import OfflineDataset, starts_from_ends
from envtf_lit.data.sources.files import save_dataset
from envtf_lit.figures.planning import PlanPicture, plan_picture
from envtf_lit.files import write_json
from envtf_lit.planning.objective import imagined_paths
from envtf_lit.planning.options import PlannerOptions
from envtf_lit.planning.pendulum import CHART, ENV_ID, MAX_TORQUE, STEP, TruePendulum
from envtf_lit.planning.planner import chosen
from envtf_lit.planning.registry import PLANNERS
from envtf_lit.planning.value_iteration import ValueIteration, ValueIterationOptions
from envtf_lit.policy import Policy, RandomPolicy, begin_episodes
from envtf_lit.results import claim
from envtf_lit.studies.machine import facts, seconds
from envtf_lit.studies.suite import cached_result
from envtf_lit.world_models.fit import fit_world_model
from envtf_lit.world_models.interface import WorldModel
from envtf_lit.world_models.options import TransformerOptions
from envtf_lit.world_models.store import load_world_model

WORK = Path(".envtf/planning")  # where data and model are kept unless told otherwise
RANGE = [-MAX_TORQUE], [MAX_TORQUE]
VALUE_ITERATION = "value_iteration"
FAMILIES = (*PLANNERS, VALUE_ITERATION)
KEYS = ("return_mean", "return_std", "decisions_per_second")
SHOWN = "icem"  # whose plan is drawn
MODEL = TransformerOptions(
    layers=1, heads=2, width=32, context=4, random_features=32, updates=6_000, updates_per_epoch=1_000, batch_size=64
)


@dataclass(frozen=True)
class PlanningOptions:
    """The amounts.

    Attributes:
        transitions: random steps that the model is learned from.
        updates: gradient steps of its training.
        episodes: that each family plays, the same for all.
        steps: of an episode.
        decisions: that are timed, one episode at a time.
        seed: of everything random.
        threads: of the CPU.
    """

    transitions: int = 20_000
    updates: int = MODEL.updates
    episodes: int = 10
    steps: int = 200
    decisions: int = 50
    seed: int = 0
    threads: int = 1


def run_planning(
    out: Path | None = None,
    *,
    work: Path = WORK,
    options: PlanningOptions,
    planners: Mapping[str, PlannerOptions | ValueIterationOptions] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Learns the model, unless it lies in the work folder, and plays every family through it and through the truth.

    Args:
        out: JSON file of the result; the picture of a plan lies beside it. None writes neither.
        work: folder of data, model and what is measured; what lies there from an earlier call is used again.
        options: the amounts.
        planners: options of families, by name; the others have their defaults.
        progress: shows a bar in training.

    Returns:
        Flat: `random.return_mean`; by family and world (`learned`, `true`) returns and decisions per second, and the
        `share` of each family; the options, and the machine.

    Raises:
        UserError: `out` is there and no such result.
    """
    if out is not None:
        claim(out, "icem.share", [out.with_suffix(".png")])
    torch.set_num_threads(options.threads)
    settings, planners = asdict(options), planners or {}
    work = work / f"pendulum-{options.transitions}-{options.updates}-{options.seed}"
    folder = learned_pendulum(work, options, progress)
    worlds = {"true": TruePendulum(), "learned": load_world_model(folder)}
    idle = RandomPolicy(*(torch.tensor(bound) for bound in RANGE))
    result: dict[str, Any] = {"random.return_mean": float(play(idle, options).mean())}
    for family in FAMILIES:
        for name, model in worlds.items():
            own = planners.get(family) or default_options(family)
            one, key = partial(measure, family, model, options, own), settings | {"planner": asdict(own)}
            found = cached_result(work, f"{family}-{name}", key, [folder] if name == "learned" else [], one)
            result |= {f"{family}.{name}.{key}": value for key, value in found.items()}
        floor = result["random.return_mean"]
        gains = [result[f"{family}.{name}.return_mean"] - floor for name in ("learned", "true")]
        result[f"{family}.share"] = gains[0] / gains[1]
    result |= settings | {f"model.{name}": value for name, value in asdict(MODEL.model).items()}
    result |= facts(torch.device("cpu"), "fp32")
    if out is not None:
        write_json(out, result)
        plan_picture(picture(worlds["learned"], options.seed), out.with_suffix(".png"))
    return result


def planning_table(result: dict[str, Any]) -> str:
    """The result as a Markdown table: a line for each family."""
    lines = ["| planner | true simulator | learned model | share of the gain | decisions/s, true | learned |"]
    lines.append("|---" * 6 + "|")
    for family in FAMILIES:
        true, learned = ({key: result[f"{family}.{name}.{key}"] for key in KEYS} for name in ("true", "learned"))
        returns = [f"{world['return_mean']:.0f} ± {world['return_std']:.0f}" for world in (true, learned)]
        rates = [f"{world['decisions_per_second']:.0f}" for world in (true, learned)]
        cells = [family, *returns, f"{result[f'{family}.share']:.3f}", *rates]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def learned_pendulum(work: Path, options: PlanningOptions, progress: bool) -> Path:
    """The folder of a world model of `random_steps`."""
    data, folder = work / "random.h5", work / "world_model"
    if not data.exists():
        save_dataset(random_steps(options.transitions, options.seed), data)
    if not folder.exists():
        train = replace(MODEL, updates=options.updates, updates_per_epoch=_epoch(options))
        fit_world_model(
            train,
            data,
            folder,
            seed=options.seed,
            precision="fp32",
            compile=False,
            settings=asdict(train) | {"seed": options.seed},
            root=work,
            progress=progress,
        )
    return folder


def _epoch(options: PlanningOptions) -> int:
    """Updates of an epoch: the usual ones, or all where those do not divide the budget."""
    return MODEL.updates_per_epoch if options.updates % MODEL.updates_per_epoch == 0 else options.updates


def random_steps(count: int, seed: int) -> OfflineDataset:
    """So many steps of Pendulum-v1 under uniform torques, in episodes of 200 steps; a tenth of them is held out."""
    env = gymnasium.make(ENV_ID)
    env.action_space.seed(seed)
    rows = []
    observation, _ = env.reset(seed=seed)
    for row in range(count):
        action = env.action_space.sample()
        following, reward, _, truncated, _ = env.step(action)
        rows.append((observation, action, reward, following, truncated or row == count - 1))
        observation = env.reset()[0] if truncated else following
    env.close()
    observations, actions, rewards, following, ends = (np.array(column) for column in zip(*rows, strict=True))
    return OfflineDataset(
        observations=observations.astype(np.float32),
        actions=actions.astype(np.float32),
        rewards=rewards.astype(np.float32),
        next_observations=following.astype(np.float32),
        terminated=np.zeros(count, bool),
        truncated=ends.astype(bool),
        episode_starts=starts_from_ends(ends),
        action_low=np.array(RANGE[0], np.float32),
        action_high=np.array(RANGE[1], np.float32),
    ).with_split(0.1, seed)


def default_options(family: str) -> PlannerOptions | ValueIterationOptions:
    """The options that a family has where none are given."""
    return ValueIterationOptions() if family == VALUE_ITERATION else PLANNERS[family].Options()


def make_family(family: str, model: WorldModel, seed: int, own: PlannerOptions | ValueIterationOptions) -> Policy:
    """A planner through a model of the pendulum."""
    if isinstance(own, ValueIterationOptions):
        return ValueIteration(model, CHART, *RANGE, own)
    return PLANNERS[family](model, *RANGE, own, seed=seed)


def measure(
    family: str, model: WorldModel, options: PlanningOptions, own: PlannerOptions | ValueIterationOptions
) -> dict[str, float]:
    """A family's returns through a model, and its decisions per second (of one episode at a time)."""
    returns = play(make_family(family, model, options.seed, own), options)
    policy, alone = make_family(family, model, options.seed, own), torch.tensor([[-1.0, 0.0, 0.0]])
    spent = [seconds(lambda: policy.act(alone), torch.device("cpu")) for _ in range(options.decisions + 1)][1:]
    return {
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "decisions_per_second": 1.0 / float(np.median(spent)),
    }


def play(policy: Policy, options: PlanningOptions) -> np.ndarray:
    """Returns (E,) of episodes of Pendulum-v1, all side by side; episode i begins with the seed `seed + i`."""
    envs = [gymnasium.make(ENV_ID, max_episode_steps=options.steps) for _ in range(options.episodes)]
    seen = [env.reset(seed=options.seed + i)[0] for i, env in enumerate(envs)]
    generator, returns, over = torch.Generator().manual_seed(options.seed), np.zeros(len(envs)), False
    begin_episodes(policy)
    while not over:
        deterministic = not isinstance(policy, RandomPolicy)
        actions = policy.act(torch.from_numpy(np.stack(seen)), deterministic, None if deterministic else generator)
        steps = [env.step(action) for env, action in zip(envs, actions.numpy(), strict=True)]
        seen, returns, over = [step[0] for step in steps], returns + [float(step[1]) for step in steps], steps[0][3]
    for env in envs:
        env.close()
    return returns


def watch(policy: Policy, *, seed: int, steps: int) -> np.ndarray:
    """Observations (steps + 1, 3) of one episode of Pendulum-v1 under deterministic actions."""
    env = gymnasium.make(ENV_ID, max_episode_steps=steps)
    seen = [env.reset(seed=seed)[0]]
    begin_episodes(policy)
    for _ in range(steps):
        action = policy.act(torch.from_numpy(seen[-1])[None], True)
        seen.append(env.step(action[0].numpy())[0])
    env.close()
    return np.stack(seen)


def angles(observations: np.ndarray) -> np.ndarray:
    """Angles (...) in rad of observations (..., 3), upright at 0."""
    return np.arctan2(observations[..., 1], observations[..., 0])


def picture(model: WorldModel, seed: int, family: str = SHOWN, own: PlannerOptions | None = None) -> PlanPicture:
    """A plan from the pendulum at rest, hanging, as one family finds it: its angle, upright at 0, and its torque."""
    planner = PLANNERS[family](model, *RANGE, own, seed=seed)
    found = planner.search(torch.tensor([[-1.0, 0.0, 0.0]]))
    groups = found.candidates, chosen(found.candidates, found.elites), found.taken[:, None]
    curves = [_curves(model, planner.state, planner.scaled(plans)) for plans in groups]
    return PlanPicture(*curves, step=STEP, labels=("angle (rad)", "torque (N m)"), title=family)


def _curves(model: WorldModel, state: Any, plans: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Angles (N, H + 1), continued beyond half a turn, and torques (N, H) of plans (1, N, H, 1)."""
    seen = imagined_paths(model, state, plans)[0].numpy()
    return np.unwrap(angles(seen), axis=1), plans[0, ..., 0].numpy()
