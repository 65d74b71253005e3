"""A dataset's card: what it holds and where it came from, as JSON and as a page to read."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.tasks import get_task

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def dataset_card(dataset: OfflineDataset, source: str, origin: dict[str, Any]) -> dict[str, Any]:
    """What a dataset holds and how it came about, ready for JSON.

    Args:
        dataset: all of it.
        source: as in `DownloadOptions`.
        origin: what `sources.make_dataset` says of it.

    Returns:
        task, source, transitions, episodes, terminated and truncated episodes, steps per episode, the distribution of
        episode returns, D4RL-normalised scores where the robot is known (and the source is not Minari, whose sets have
        no such scores), the environment that scores policies, and the origin.
    """
    lengths = dataset.episode_lengths
    card: dict[str, Any] = {
        "task": dataset.task,
        "source": source,
        "transitions": len(dataset),
        "episodes": len(lengths),
        "terminated": int(dataset.terminated.sum()),
        "truncated": int((dataset.truncated & ~dataset.terminated).sum()),
        "episode_steps": {"min": int(lengths.min()), "mean": float(lengths.mean()), "max": int(lengths.max())},
        "returns": distribution(dataset.episode_returns),
    }
    if dataset.task is not None:
        robot = get_task(dataset.task).robot
        card["env_id"] = robot.env_id
        if source != "minari":
            mean, best = float(dataset.episode_returns.mean()), float(dataset.episode_returns.max())
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
        "truncated",
        "steps per episode": f"{steps['mean']:.0f} on average, from {steps['min']:,} to {steps['max']:,}",
        "D4RL-normalised score of its episodes": f"{scores['mean']:.1f} on average, at most {scores['max']:.1f}",
        "seed": card["seed"],
        "actions": card["actions"],
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


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Rows of cells under a head, in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _arguments(env_kwargs: dict[str, Any]) -> str:
    return "".join(f", `{name}={value}`" for name, value in env_kwargs.items())


def _number(value: float | None, digits: int = 0) -> str:
    return "" if value is None else f"{value:,.{digits}f}"
