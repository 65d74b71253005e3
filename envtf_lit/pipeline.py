"""One function per stage: the command line, DVC, the notebooks and the tests call the same ones.

Each reads what the stages before it wrote below `root`, writes its own outputs there, and returns its metrics.
"""

import contextlib
import resource
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning as L
import torch

from envtf_lit.errors import UserError
from envtf_lit.params import Params, PolicyOptions
from envtf_lit.storage import pick_device, read_json, replacing, write_json
from envtf_lit.tasks import Robot, get_task, never_terminated

DATASET, CARD = Path("data/dataset.h5"), Path("data/dataset.json")
TERMINATION = "termination"  # below the world model, where it had to be learned
CURVES = "curves.csv"  # below every model
WORLD_MODEL, BEHAVIOUR = Path("models/world_model"), Path("models/behaviour")
ROLLOUTS, POLICIES = Path("data/rollouts.h5"), Path("models/policy")
REPORTS, METRICS = Path("reports"), Path("reports/metrics.json")
PLOTS, VIDEO = Path("reports/plots"), Path("reports/video")
ALGORITHMS = ("cql", "et_cql")


def download(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Makes or reads the dataset: `data/dataset.h5` and its card, which is returned."""
    from envtf_lit.data.cards import dataset_card
    from envtf_lit.data.formats import save_dataset
    from envtf_lit.data.sources import make_dataset

    with _stage("download", params, root):
        dataset, origin = make_dataset(
            None if params.task is None else get_task(params.task),
            params.download,
            seed=params.seed,
            workers=params.threads,
            progress=progress,
        )
        save_dataset(dataset, root / DATASET)
        card = dataset_card(dataset, params.download.source, origin)
        write_json(root / CARD, card)
    return card


def train_model(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Trains the world model and keeps the weights of least held-out open-loop error: `models/world_model/`."""
    with _stage("train_model", params, root):
        return fit_world_model(params, root / DATASET, root / WORLD_MODEL, root=root, progress=progress)


def fit_world_model(
    params: Params, dataset: Path, target: Path, *, root: Path = Path("."), progress: bool = True
) -> dict[str, Any]:
    """Trains the world model that `params.train_model` describes on a dataset file and writes its folder.

    Args:
        params: train_model, seed and precision count; threads and global seeds are the caller's.
        dataset: HDF5 or NPZ.
        target: folder of the weights, metrics, curves and resolved options.
        root: below it lies what a killed run continues from.
        progress: shows a bar.

    Returns:
        Parameters, epoch of the kept weights, and their held-out errors; those of the termination head, too, where
        the data are of a robot whose rule is unknown, and some episode terminates.
    """
    from envtf_lit.training import fit, run_folder
    from envtf_lit.world_models.lit import lit_world_model, window_data

    options = params.train_model
    budget = options.ensemble or options
    data = window_data(str(dataset), options, seed=params.seed)
    lit = lit_world_model(data.observation_dim, data.action_dim, options, seed=params.seed, compile=params.compile)
    key = _key(params, asdict(options))
    curves = fit(
        lit,
        data,
        run=run_folder(root, "train_model", key, [dataset]),
        epochs=budget.updates // budget.updates_per_epoch,
        precision=params.precision,
        progress=progress,
        monitor=lit.monitor,
        gradient_clip=lit.gradient_clip,
    )
    best = curves.rows[-1] if (name := lit.monitor) is None else min(curves.rows, key=lambda row: row[name])
    return publish_world_model(target, lit, data, curves, best, key)


def publish_world_model(
    target: Path, lit: Any, data: Any, curves: Any, best: Mapping[str, float], settings: dict[str, Any]
) -> dict[str, Any]:
    """Fits what comes after training, uncertainty and perhaps a termination head, and writes a world model's folder.

    Args:
        target: folder of the weights, metrics, curves and resolved options.
        lit: the `LitWorldModel` that holds the weights to keep.
        data: the `WindowData` that it was trained on, set up.
        curves: the `Curves` of the training.
        best: the row of them that belongs to the weights; it may lack what was not logged.
        settings: the resolved options.

    Returns:
        As `fit_world_model`.
    """
    from envtf_lit.world_models.store import save_world_model
    from envtf_lit.world_models.termination import learn_termination, save_termination

    lit.fit_uncertainty(data)
    names = {"epoch": "epoch", "open_loop_error": "val/open_loop_error", "val_loss": "val/loss"}
    metrics: dict[str, Any] = {"parameters": sum(p.numel() for p in lit.kept.parameters())}
    metrics |= {name: best[column] for name, column in names.items() if column in best}
    head = learn_termination(data.train, seed=lit.seed) if data.dataset.task is None else None
    with replacing(target) as folder:
        save_world_model(folder, lit.kept)
        if head is not None:
            save_termination(folder / TERMINATION, head)
            metrics |= head.scores(data.held_out)
        _record(folder, metrics, settings, curves)
    return metrics


def generate_rollouts(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Clones the behaviour policy and lets it act in the world model: `models/behaviour/`, `data/rollouts.h5`."""
    from envtf_lit.agents.bc import clone_behaviour
    from envtf_lit.data.formats import load_dataset
    from envtf_lit.imagination import BranchPoints, NoisyPolicy, imagine, save_rollouts
    from envtf_lit.policy import save_policy
    from envtf_lit.training import autocast, run_folder
    from envtf_lit.world_models.store import load_world_model

    options = params.generate_rollouts
    with _stage("generate_rollouts", params, root):
        key = _key(params, asdict(options)) | _unseen(params)
        dataset = load_dataset(root / DATASET)
        run = run_folder(root, "generate_rollouts", key, [root / DATASET])
        clone, curves = clone_behaviour(
            root / DATASET,
            options,
            seed=params.seed,
            run=run,
            precision=params.precision,
            progress=progress,
            **_unseen(params),
        )
        with replacing(root / BEHAVIOUR) as folder:
            save_policy(folder, clone)
            curves.write(folder / CURVES)
        device = pick_device()
        model = load_world_model(root / WORLD_MODEL, fused=params.compile).to(device)
        generator = torch.Generator(device).manual_seed(params.seed)
        points = BranchPoints(dataset, device)
        starts = points.draw_shared(options.branches, options.history, options.share, generator)
        begin = time.perf_counter()
        with autocast(device, params.precision):
            rollouts = imagine(
                model,
                NoisyPolicy(clone.to(device), options.exploration),
                starts,
                horizon=options.horizon,
                terminated=_termination(params, root, device),
                novelty_limit=options.novelty_limit,
                mode=options.mode,
                generator=generator,
            )
        rate = len(rollouts) / (time.perf_counter() - begin)
        metrics = {
            "transitions": len(rollouts),
            "terminated": int(rollouts.terminated.sum()),
            "halted": int(rollouts.halted.sum()),
            "uncertainty_mean": float(rollouts.uncertainty.mean()),
        }
        save_rollouts(rollouts, root / ROLLOUTS, provenance=key | {"task": params.task})
        _note_timing(root, "imagined_transitions_per_second", rate)
    return metrics


def train_policy(
    params: Params, root: Path = Path("."), *, algorithm: str = "et_cql", progress: bool = True
) -> dict[str, Any]:
    """Trains `cql` (data alone) or `et_cql` (data and imagination): `models/policy/<algorithm>/`."""
    from envtf_lit.agents.cql import CQL
    from envtf_lit.data.loaders import TransitionData
    from envtf_lit.training import fit, run_folder

    options: PolicyOptions = getattr(params.train_policy, algorithm)
    with _stage(f"train_policy_{algorithm}", params, root):
        data = TransitionData(
            str(root / DATASET),
            batch_size=options.batch_size,
            updates_per_step=options.updates_per_step,
            steps_per_epoch=options.updates_per_epoch // options.updates_per_step,
            discount=options.discount,
            n_step=options.n_step,
            return_temperature=options.return_temperature,
            **_unseen(params),
            seed=params.seed,
        )
        agent = CQL(
            data.observation_dim,
            data.action_dim,
            options,
            action_low=data.action_low,
            action_high=data.action_high,
            seed=params.seed,
        )
        inputs, monitor = [root / DATASET], None
        if options.imagination is not None:
            _give_imagination(agent, params, root, data.dataset)
            inputs += [root / WORLD_MODEL, root / ROLLOUTS]
            monitor = "val/imagined_return" if options.imagination.selection_episodes > 0 else None
        key = _key(params, asdict(options)) | _unseen(params)
        curves = fit(
            agent,
            data,
            run=run_folder(root, f"train_policy_{algorithm}", key, inputs),
            epochs=options.updates // options.updates_per_epoch,
            precision=params.precision,
            progress=progress,
            monitor=monitor,
            mode="max",
            validate=False,
        )
        kept = max(curves.rows, key=lambda row: row[monitor]) if monitor else curves.rows[-1]
        return publish_policy(root / POLICIES / algorithm, agent.average_actor, curves, kept, key)


def publish_policy(
    target: Path, actor: Any, curves: Any, kept: Mapping[str, float], settings: dict[str, Any]
) -> dict[str, Any]:
    """Writes a policy's folder.

    Args:
        target: folder of the weights, metrics, curves and resolved options.
        actor: the `TanhGaussianActor` to keep.
        curves: the `Curves` of the training.
        kept: the row of them that belongs to the actor.
        settings: the resolved options.

    Returns:
        The row, its columns named without their split.
    """
    from envtf_lit.policy import save_policy

    metrics = {name.rpartition("/")[2]: value for name, value in kept.items()}
    with replacing(target) as folder:
        save_policy(folder, actor)
        _record(folder, metrics, settings, curves)
    return metrics


def evaluate(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Scores policies and the model: `reports/metrics.json`, `plots/`, `video/`.

    The model is scored on held-out episodes, policies in MuJoCo. For a robot without a simulator (`task: null`) there
    are no scores: what the model promises the policies, and how they agree with held-out actions, is all.
    """
    from envtf_lit.data.formats import load_dataset
    from envtf_lit.evaluation.evidence import collect_metrics, collect_promises, world_model_metrics
    from envtf_lit.evaluation.offline import judge
    from envtf_lit.evaluation.returns import evaluate_policy
    from envtf_lit.figures import gallery
    from envtf_lit.figures.video import no_video, real_vs_imagined
    from envtf_lit.imagination import load_rollouts
    from envtf_lit.policy import load_policy
    from envtf_lit.world_models.horizon import Scale, horizon_report, whole_episodes
    from envtf_lit.world_models.recalibration import calibration_split
    from envtf_lit.world_models.store import load_world_model

    options, robot, source = params.evaluate, _robot(params), params.download.source
    with _stage("evaluate", params, root):
        dataset, rollouts = load_dataset(root / DATASET), load_rollouts(root / ROLLOUTS)
        model = load_world_model(root / WORLD_MODEL)
        training, held_out = dataset.split(params.train_model.held_out, seed=params.seed)
        _, held_out = calibration_split(held_out)
        scale = Scale.of(training)
        report = horizon_report(model, whole_episodes(held_out, options.trajectories, seed=params.seed), scale)
        folders = {"bc": BEHAVIOUR, **{name: POLICIES / name for name in ALGORITHMS}}
        policies = {name: load_policy(root / folder) for name, folder in folders.items()}
        curves = {name: _curves(root / POLICIES / name) for name in ALGORITHMS}
        facts: dict[str, Any] = dict(
            seed=params.seed,
            dataset=dataset,
            world_model=world_model_metrics(report, scale, parameters=sum(p.numel() for p in model.parameters()))
            | {"termination": _termination_used(params, root)},
            rollouts=len(rollouts),
        )
        with replacing(root / PLOTS) as plots, replacing(root / VIDEO) as video:
            plots.mkdir()
            video.mkdir()
            gallery.draw_dataset(dataset, source, plots)
            gallery.draw_world_model(report, scale, robot, _curves(root / WORLD_MODEL), plots)
            gallery.draw_rollouts(rollouts.step.numpy(), rollouts.uncertainty.numpy(), plots)
            if robot is None:
                promises = judge(model, policies, report, training)
                metrics = collect_promises(promises, **facts)
                gallery.draw_promises(promises, curves, plots)
                no_video(video)
            else:
                returns = {
                    name: evaluate_policy(policy, robot, episodes=options.episodes, seed=params.seed, progress=progress)
                    for name, policy in policies.items()
                }
                metrics = collect_metrics(returns, task=str(params.task), source=source, robot=robot, **facts)
                gallery.draw_policies(dataset, source, robot, returns, curves, plots)
                episode, gif = returns["et_cql"].median, video / "real_vs_imagined.gif"
                real_vs_imagined(model, episode, robot, scale, gif, frames=options.video_frames)
        write_json(root / METRICS, metrics)
    return metrics


def report(params: Params, root: Path = Path("."), *, progress: bool = True) -> dict[str, Any]:
    """Executes `notebooks/report.ipynb` on the other stages' outputs: `reports/report.ipynb` and `.html`."""
    from envtf_lit.figures.notebook import execute

    with _stage("report", params, root):
        page = execute(
            root / "notebooks/report.ipynb",
            root / REPORTS / "report.ipynb",
            {"root": "."},
            cwd=root,
            progress=progress,
        )
    return {"report": str(page)}


def _give_imagination(agent: Any, params: Params, root: Path, dataset: Any) -> None:
    """Hands an agent the world model and the stored rollouts."""
    from envtf_lit.data.loaders import return_weights
    from envtf_lit.imagination import Imagination, load_rollouts
    from envtf_lit.world_models.store import load_world_model

    device = pick_device()
    model = load_world_model(root / WORLD_MODEL, fused=params.compile).to(device)
    temperature = agent.options.return_temperature
    weights = None if temperature is None else return_weights(dataset, temperature)  # as the real rows are drawn
    imagination = Imagination(
        model, dataset, _termination(params, root, device), agent.options.imagination, device, weights
    )
    agent.dream_with(imagination, load_rollouts(root / ROLLOUTS), reward_std=float(dataset.rewards.std()))


def _robot(params: Params) -> Robot | None:
    return None if params.task is None else get_task(params.task).robot


def _termination(params: Params, root: Path, device: torch.device) -> Callable[[torch.Tensor], torch.Tensor]:
    """The robot's rule, or the learned one; where there is neither, imagined rollouts end at their horizon alone."""
    from envtf_lit.world_models.termination import load_termination

    match _termination_used(params, root):
        case "rule":
            return get_task(str(params.task)).robot.terminated
        case "learned":
            return load_termination(root / WORLD_MODEL / TERMINATION).to(device).terminated
        case _:
            return never_terminated


def _termination_used(params: Params, root: Path) -> str:
    """Where imagined rollouts end: by the robot's `rule`, a `learned` one, or `none`."""
    if params.task is not None:
        return "rule"
    return "learned" if (root / WORLD_MODEL / TERMINATION).exists() else "none"


def _unseen(params: Params) -> dict[str, float]:
    """What policies must not see: where no simulator can score them, held-out actions have to."""
    return {"held_out": params.train_model.held_out} if params.task is None else {}


def _key(params: Params, options: dict[str, Any]) -> dict[str, Any]:
    """What a run's result depends on, beside its input files."""
    common = {name: getattr(params, name) for name in ("seed", "threads", "precision", "compile")}
    return common | {"options": options}


def _record(folder: Path, metrics: dict[str, Any], settings: dict[str, Any], curves: Any) -> None:
    """Metrics, resolved options and curves beside the weights."""
    write_json(folder / "metrics.json", metrics)
    write_json(folder / "resolved.json", settings)
    curves.write(folder / CURVES)


def _curves(folder: Path) -> Any:
    import pandas as pd

    try:
        return pd.read_csv(folder / CURVES)
    except (FileNotFoundError, pd.errors.EmptyDataError):
        raise UserError(
            f"{folder} has no {CURVES}, which the plots are drawn from: run the stage that writes the folder, or copy "
            "one there that `fit` published after an epoch or more."
        ) from None


@contextlib.contextmanager
def _stage(name: str, params: Params, root: Path) -> Iterator[None]:
    """Threads and seeds for a stage; its wall time and peak memory go to a side file that no hash covers."""
    torch.set_num_threads(params.threads)
    L.seed_everything(params.seed, verbose=False)
    begin = time.perf_counter()
    yield
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    _note_timing(root, name, {"seconds": round(time.perf_counter() - begin, 1), "peak_memory_mb": round(peak)})


def _note_timing(root: Path, name: str, value: Any) -> None:
    path = root / ".envtf" / "timings.json"
    with contextlib.suppress(ValueError):  # a damaged side file is begun anew
        timings = read_json(path) if path.exists() else {}
        write_json(path, timings | {name: value})
