"""A dataset's card as a page to read."""

from collections.abc import Iterable, Sequence
from typing import Any


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
