"""A dataset's card: what it holds and where it came from, as JSON and as a page to read."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.robots.tasks import Robot, get_task

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
UNLIMITED = ("file", "minari")  # sources that say nothing of the time limit under which they were recorded
UNSCORED = ("minari",)  # sources whose returns D4RL's references have nothing to do with


def cut_short(dataset: OfflineDataset, source: str) -> np.ndarray:
    """(E,) bool, the episodes that neither terminated nor came to the robot's time limit.

    They are cut where the rows of a policy, or of the log, end: what they would have returned nobody knows. None is,
    as far as can be told, where the robot is unknown or the source may have had a limit of its own.

    Args:
        dataset: all of it.
        source: as in `DownloadOptions`.
    """
    if dataset.task is None or source in UNLIMITED:
        return np.zeros(len(dataset.episode_starts), bool)
    return ~dataset.finished(get_task(dataset.task).robot.max_episode_steps)


def counted_episodes(dataset: OfflineDataset, source: str) -> np.ndarray:
    """(E,) bool, the episodes whose returns count: those that are not cut short, or all where there are no others."""
    cut = cut_short(dataset, source)
    return ~cut | cut.all()


def dataset_card(dataset: OfflineDataset, source: str, origin: dict[str, Any]) -> dict[str, Any]:
    """What a dataset holds and how it came about, ready for JSON.

    Args:
        dataset: all of it.
        source: as in `DownloadOptions`.
        origin: what `sources.make_dataset` says of it.

    Returns:
        task, source, transitions, episodes, terminated and truncated episodes, how many of the latter are cut short
        (and left out of what follows, unless all are), steps per episode, the distribution of their returns, the
        limits of the actions, how many episodes are held out (if that was chosen),
        D4RL-normalised scores where the robot is known (and the source is not Minari, whose sets have no such scores),
        the environment that scores policies, and the origin.
    """
    counted = counted_episodes(dataset, source)
    lengths, returns = dataset.episode_lengths[counted], dataset.episode_returns[counted]
    card: dict[str, Any] = {
        "task": dataset.task,
        "source": source,
        "transitions": len(dataset),
        "episodes": len(counted),
        "terminated": int(dataset.terminated.sum()),
        "truncated": int((dataset.truncated & ~dataset.terminated).sum()),
        "cut_short": int(cut_short(dataset, source).sum()),
        "episode_steps": {"min": int(lengths.min()), "mean": float(lengths.mean()), "max": int(lengths.max())},
        "returns": distribution(returns),
        "action_low": dataset.action_low.tolist(),
        "action_high": dataset.action_high.tolist(),
    }
    if dataset.held_out is not None:
        card["held_out_episodes"] = int(dataset.held_out.sum())
    if dataset.task is not None:
        robot = get_task(dataset.task).robot
        card["env_id"] = robot.env_id
        if source not in UNSCORED:
            mean, best = float(returns.mean()), float(returns.max())
            card["scores"] = {"mean": robot.normalised_score(mean), "max": robot.normalised_score(best)}
    return card | origin


def distribution(values: np.ndarray) -> dict[str, float]:
    """Mean, standard deviation, least, quantiles and greatest of values (E,)."""
    quantiles = {f"quantile_{q:g}": float(np.quantile(values, q)) for q in QUANTILES}
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        **quantiles,
        "max": float(values.max()),
    }


def card_page(card: dict[str, Any]) -> str:
    """A card, as `dataset_card` gives it for the zoo, in Markdown."""
    scores, steps = card["scores"], card["episode_steps"]
    facts = {
        "environment": f"Gymnasium `{card['env_id']}`" + _arguments(card["env_kwargs"]),
        **({"hidden dynamics": card["hidden_dynamics"]} if "hidden_dynamics" in card else {}),
        "transitions": f"{card['transitions']:,}",
        "episodes": f"{card['episodes']:,}, of which {card['terminated']:,} terminated and {card['truncated']:,} were "
        f"truncated{_cut(card)}",
        "steps per episode": f"{steps['mean']:.0f} on average, from {steps['min']:,} to {steps['max']:,}",
        "D4RL-normalised score of its episodes": f"{scores['mean']:.1f} on average, at most {scores['max']:.1f}",
        "seed": card["seed"],
        "actions": f"{card['actions']}, in [{min(card['action_low']):g}, {max(card['action_high']):g}]",
        "policies trained with": card["trained_with"],
        "versions": ", ".join(f"{name} {number}" for name, number in card["versions"].items()),
    }
    policies = (
        (
            policy["policy"],
            f"{policy['transitions']:,}",
            _number(policy["mean_return_deterministic"]),
            _number(policy["score_deterministic"], 1),
        )
        for policy in card["policies"]
    )
    returns = ((name.replace("quantile_", "quantile "), _number(value)) for name, value in card["returns"].items())
    return (
        "\n\n".join(
            (
                f"# {card['task']}",
                card["note"],
                markdown_table(("", ""), facts.items()),
                "## Policies, in the order of the rows",
                markdown_table(("policy", "transitions", "return, deterministic", "score"), policies),
                "## Returns of its episodes",
                markdown_table(("", "return"), returns),
            )
        )
        + "\n"
    )


def _cut(card: dict[str, Any]) -> str:
    count = card["cut_short"]
    left_out = "" if count == card["episodes"] else ", and left out below"
    return f" ({count:,} of them cut short where a policy's rows end{left_out})" if count else ""


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Rows of cells under a head, in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _arguments(env_kwargs: dict[str, Any]) -> str:
    return "".join(f", `{name}={value}`" for name, value in env_kwargs.items())


def _number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:,.{digits}f}"


def dataset_scores(dataset: OfflineDataset, robot: Robot, source: str) -> np.ndarray:
    """(E,) D4RL-normalised score of each recorded episode that counts (see `counted_episodes`)."""
    counted = dataset.episode_returns[counted_episodes(dataset, source)]
    return np.array([robot.normalised_score(value) for value in counted])
