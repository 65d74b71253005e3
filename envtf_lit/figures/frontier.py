"""The frontier of trust: what the world model promises of policies, against how far they are from the log."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from envtf_lit.agents.trust_levels import CLONE, LEVELS
from envtf_lit.evaluation.promises import ERRORS, Places, kept, promised_range
from envtf_lit.figures.style import COLOURS, drawing, policy_colours, write_table


def frontier_picture(
    frontiers: Mapping[str, Places],
    path: str | Path,
    *,
    held_out: Mapping[str, float],
    recorded: float,
    policies: Mapping[str, str],
    measured: Mapping[str, float] | None = None,
) -> Path:
    """Promised returns with their ranges over the distance from the log; clone and published policy are marked.

    Args:
        frontiers: of each policy that has one, by name, as `read_frontier` gives them.
        path: PNG to write; the numbers go beside it as CSV.
        held_out: of the metrics: how the model errs on recorded actions.
        recorded: mean return of the log's episodes.
        policies: what to call each policy, in the order of params.yaml, which gives the colours.
        measured: mean returns in a simulator, where there is one, of policies by name and of clones by `NAME/clone`.
    """
    colours, measured = policy_colours(policies), measured or {}
    tables = {name: _with_ranges(table, held_out) for name, table in frontiers.items()}
    with drawing(path, (8.6, 4.8)) as (figure, axes):
        axis = axes[0, 0]
        axis.axhline(recorded, color=COLOURS["recorded"], linestyle="--", linewidth=1.2, label="the log's mean episode")
        for name, table in tables.items():
            _draw(axis, table, colours[name], policies[name] if len(tables) > 1 else "promised")
            marked = (frontiers[name][0], "D", 90, "the clone"), (kept(frontiers[name]), "o", 170, "published")
            for row, marker, size, words in marked:
                axis.scatter(row["excess"], row["promise"], s=size, marker=marker, facecolors="none",
                             edgecolors="black", linewidths=1.6, label=words, zorder=4)  # fmt: skip
            for row, key in ((frontiers[name][0], f"{name}/{CLONE}"), (kept(frontiers[name]), name)):
                if key in measured:
                    axis.scatter(row["excess"], measured[key], s=130, marker="*", color=colours[name],
                                 edgecolors="black", zorder=5, label="measured")  # fmt: skip
        least, most = axis.get_xlim()
        for level, found in LEVELS.items():
            if least < found.slack < most:
                axis.axvline(found.slack, color=COLOURS["threshold"], linestyle=":", linewidth=1.2)
                note = f"{level}:\nno further"
                axis.annotate(note, (found.slack, 1.0), xycoords=("data", "axes fraction"), xytext=(-3, -3),
                              textcoords="offset points", ha="right", va="top", fontsize="x-small",
                              bbox=dict(facecolor=axis.get_facecolor(), linewidth=0, pad=1.0))  # fmt: skip
        axis.set(
            xlabel="distance from the log: how much likelier the clone makes held-out actions (nats per dimension)"
        )
        axis.set_ylabel("return of an episode\n(bar: of the mean; line: of an episode)")
        axis.set_title("What the world model promises, and how far from the log")
        entries = dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))  # one of each
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=5, fontsize="small")
    write_table(path, pd.concat([table.assign(policy=name) for name, table in tables.items()]))
    return Path(path)


def _with_ranges(frontier: Places, held_out: Mapping[str, float]) -> pd.DataFrame:
    ranges = [promised_range(row, held_out) for row in frontier]
    return pd.DataFrame(frontier).assign(low=[found.low for found in ranges], high=[found.high for found in ranges])


def _draw(axis: Axes, table: pd.DataFrame, colour: str, label: str) -> None:
    """One policy's places in the order in which they left the log."""
    axis.plot(table["excess"], table["promise"], color=colour, linewidth=1.0, alpha=0.5, zorder=2)
    axis.vlines(table["excess"], table["low"], table["high"], color=colour, linewidth=1.0, alpha=0.6, zorder=2)
    axis.errorbar(
        table["excess"], table["promise"], ERRORS * table["error"], color=colour, fmt="o", markersize=5, elinewidth=3,
        label=label, zorder=3,
    )  # fmt: skip
