"""What the report says of promises: what is promised, what was earned, who is published and why, what to try first."""

import pandas as pd

from envtf_lit.agents.trust_levels import CLONE, LEAST_GAIN, LEVELS
from envtf_lit.evaluation.promises import Range, kept, mean_range, promised_range
from envtf_lit.figures.report import Run

NEAR = LEVELS["cautious"].slack  # nats from the clone within which a policy is near the log
FAR = LEVELS["default"].slack  # beyond which it is called so, as where the model has left what it knows
STRAYED = 0.005  # of imagined steps: how much more often than the clone's a policy's may be lost without a word


def frontier_table(run: Run) -> pd.DataFrame:
    """Every actor on the frontiers, what it is promised, and how it stands to the log."""
    rows = [
        {
            "policy": run.label(name),
            "actor": "the clone" if place == 0 else f"after update {row['update']:.0f}",
            "nats from the clone": f"{row['excess']:.3f}",
            "promised": _words(promised_range(row, run.held_out)),
            "steps beyond the model": f"{row['lost']:.2%}",
            "": "published" if row["kept"] == 1 else "",
        }
        for name, table in run.frontiers.items()
        for place, row in enumerate(table)
    ]
    return pd.DataFrame(rows)


def about_promises(run: Run) -> str:
    """What each policy is promised, what the log earned, who is published and why, and how the range is made."""
    if not run.frontiers:
        return "None of these policies says what it is promised, or how far it is from the log: `et_cql` does."
    bias = (run.held_out["imagined_return_mean"] - run.held_out["return_mean"]) / run.held_out["steps_mean"]
    return _joined(
        *(_about(run, name) for name in run.frontiers),
        "A range holds nine of ten whole imagined episodes (a robot that always begins alike may live through any of",
        "them every time), and to either side what the model errs",
        f"by on held-out episodes, whose actions it was given and whose return is known: {bias:+.2g} for each step.",
    )


def _about(run: Run, name: str) -> str:
    """One policy's promise, and whether it held where that is known."""
    row = kept(run.frontiers[name])
    promise, level = promised_range(row, run.held_out), run.trust(name)
    sentences = [
        f"{run.label(name)} (`trust: {level}`) is promised **{_words(promise)}**; the log's mean episode earned",
        f"{_return(run.recorded_return)}. {_why(run, name)}",
    ]
    if run.simulated:
        found = run.policies[name]["return_mean"]
        place = "inside the range" if found in promise else "**outside the range**"
        clone = run.policies[name].get("clone_return_mean")
        sentences += [f"In the simulator it earned {_return(found)}, {place}."]
        sentences += [] if clone is None else [f"The clone earned {_return(clone)} there."]
    return _joined(*sentences, _beyond(run, name))


def _why(run: Run, name: str) -> str:
    """Which actor is published, and for what."""
    table, price = run.frontiers[name], LEVELS[run.trust(name)].price
    clone, row = table[0], kept(table)
    if row["update"] == clone["update"]:
        cost = f", and {price:.0%} for each nat of distance" if price else ""
        return f"Published is the clone: nobody further out was promised enough more, {LEAST_GAIN:.0%} at least{cost}."
    gain = (row["promise"] - row["error"] - clone["promise"]) / max(abs(clone["promise"]), 1e-9)
    paid = f", which cost {price * max(row['excess'], 0.0):.0%}" if price else ", which costs nothing"
    return (
        f"Published is the actor after update {row['update']:.0f}: {gain:+.0%} over the clone's promise, its error "
        f"deducted, for {row['excess']:.2f} nats of distance{paid} at this trust."
    )


def _beyond(run: Run, name: str) -> str:
    """How far a policy is from the log, if further than `cautious` goes; a warning where it acts beyond the log."""
    table = run.frontiers[name]
    clone, row = table[0], kept(table)
    distance = (
        f"held-out actions are {row['excess']:.2f} nats per dimension less likely under it than under the clone, and "
        f"`cautious` goes {NEAR:g} nats"
    )
    strayed = (
        f"in {row['lost']:.1%} of its imagined steps the model has left what it knows, or promises more than was ever "
        f"paid (of the clone's: {clone['lost']:.1%})"
    )
    reasons = [distance] if row["excess"] > NEAR else []
    reasons += [strayed] if row["lost"] > clone["lost"] + STRAYED else []
    if not reasons:
        return ""
    warned = row["excess"] > FAR or strayed in reasons
    place = "**acts beyond the log**" if warned else "is some way from the log"
    return f"{run.label(name)} {place}: {'; '.join(reasons)}."


def first_to_try(run: Run) -> str:
    """Where only the robot can tell: which policy and level of trust to try first, and who acts beyond the log."""
    if not run.frontiers:
        return ""
    ordered = sorted(run.frontiers, key=lambda name: kept(run.frontiers[name])["excess"])
    promises = {name: promised_range(kept(run.frontiers[name]), run.held_out) for name in ordered}
    means = {name: mean_range(kept(run.frontiers[name]), run.held_out) for name in ordered}
    sure = [name for name in ordered if means[name].low > run.recorded_return]
    name = sure[0] if sure else ordered[0]
    warnings = [_beyond(run, each) for each in ordered]
    if not sure:
        words = (
            f"**Try first what is nearest to the log**: the clone in `models/policy/{name}/{CLONE}`, or what made the "
            f"log. No policy's mean is promised to lie above the {_return(run.recorded_return)} that the log's mean "
            f"episode earned; {run.label(name)}'s is promised at {_words(means[name])}."
        )
    else:
        words = (
            f"**Try first {run.label(name)}** (`trust: {run.trust(name)}`), the nearest to the log of those whose "
            f"promised mean, {_words(means[name])}, lies above the {_return(run.recorded_return)} that the log's mean "
            f"episode earned. Be ready for any single episode of its range, {_words(promises[name])}."
        )
    return _joined(words, _before(run, name) if sure else "", *warnings)


def _before(run: Run, name: str) -> str:
    """The more cautious level to try before, where a policy is further from the log than that goes."""
    table, levels = run.frontiers[name], [run.trust(other) for other in run.frontiers]
    if kept(table)["excess"] <= NEAR or "cautious" in levels:
        return ""
    best = max((row for row in table if row["excess"] <= NEAR), key=lambda row: row["promise"])
    return (
        f"Before it, train and try `trust: cautious`, which goes {NEAR:g} nats and no further: up to there this one's "
        f"training was promised {_words(promised_range(best, run.held_out))}."
    )


def _words(found: Range) -> str:
    return f"{_return(found.low)} to {_return(found.high)}"


def _return(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _joined(*parts: str) -> str:
    return " ".join(part for part in parts if part)
