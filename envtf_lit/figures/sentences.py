"""What the report says: sentences and tables with a run's numbers in them, whichever way it went."""

import math

import numpy as np
import pandas as pd

from envtf_lit.figures.report import Run
from envtf_lit.files import read_json

# the answer


def scores_table(run: Run) -> pd.DataFrame:
    """The data's mean and each policy's, as they did in the simulator."""
    spread = "standard deviation over episodes"
    rows = [{"": "dataset, mean episode", run.unit: run.number(run.recorded), spread: ""} | NOTHING]
    for name in run.policies:
        values = {run.unit: run.number(run.mean(name)), spread: run.number(run.std(name))}
        rows.append({"": run.label(name)} | values | _learned_from(run, name))
    return pd.DataFrame(rows)


def estimates_table(run: Run) -> pd.DataFrame:
    """Recorded and imagined returns, and how far each policy's actions are from the recorded ones."""
    held_out = run.metrics["held_out"]
    known = [("recorded, held out", held_out["return_mean"], "record")]
    known += [("model, on the recorded actions", held_out["imagined_return_mean"], "imagination")]
    rows = [
        {"": what, "return": run.number(value), "known by": by, "action error": ""} | NOTHING
        for what, value, by in known
    ]
    for name, found in run.policies.items():
        values = {"return": run.number(run.mean(name)), "known by": "imagination"}
        values |= {"action error": f"{found['action_error']:.3g}"}
        rows.append({"": run.label(name)} | values | _learned_from(run, name))
    return pd.DataFrame(rows)


NOTHING = {"learned from": "", "effective episodes": ""}  # of what did not learn


def _learned_from(run: Run, policy: str) -> dict[str, str]:
    """Its data, and how many episodes their rows come from, each counted by its share (see docs/metrics.md)."""
    found = run.policies[policy]
    source = f"data, and rollouts in {found['world_model']}" if run.imagines(policy) else "data"
    episodes = found.get("effective_episodes")  # lacks in the metrics of an earlier version
    return {"learned from": source, "effective episodes": "" if episodes is None else f"{episodes:.1f}"}


def about_scores(run: Run) -> str:
    """Whom the last policy is above, and whom not."""
    score, last = run.mean(run.last), run.label(run.last)
    others = {"the data's mean": run.recorded} | {run.label(name): run.mean(name) for name in run.others}
    beaten = [name for name, value in others.items() if score > value]
    unbeaten = [name for name, value in others.items() if score <= value]
    return _joined(
        f"On `{run.metrics['task']}`, seed {run.metrics['seed']}, {last} {run.unit}s **{run.number(score)}**.",
        f"That is above {', '.join(beaten)}." if beaten else "That is above none of the others.",
        f"**It is not above {', '.join(unbeaten)}.**" if unbeaten else "",
    )


def about_estimates(run: Run) -> str:
    """How wrong imagined returns are where the truth is known, and which policies' gain is larger than that."""
    held_out, wrong = run.metrics["held_out"], run.least
    above = [run.label(name) for name in run.policies if run.mean(name) - run.recorded > wrong]
    return _joined(
        f"On the recorded actions, whose true return is known, the model errs by {wrong:.3g} per episode (root mean",
        f"square, {held_out['episodes']} episodes). For whom does it imagine more than the recorded return, by more",
        f"than that error? {', '.join(above) or 'For none of the policies'}.",
    )


# the data


def about_data(run: Run) -> str:
    """How much was recorded, how it ends, and how good it is."""
    card, unit = run.card, run.unit
    best, average = (run.metrics["dataset"][f"{unit}_{name}"] for name in ("max", "mean"))
    return _joined(
        f"{card['transitions']:,} transitions in {card['episodes']:,} episodes, of {card['episode_steps']['mean']:.0f}",
        f"steps on average; {card['terminated'] / card['episodes']:.0%} of them end in a termination, such as a fall.",
        f"Actions lie in [{min(card['action_low']):g}, {max(card['action_high']):g}].",
        f"{card['cut_short']} are cut short and not counted." if 0 < card["cut_short"] < card["episodes"] else "",
        f"The mean {unit} is {run.number(average)}, the best episode's {run.number(best)}.",
    )


def place_in_data(run: Run) -> str:
    """Where the last policy lies between the data's mean and best episode."""
    score, best = run.mean(run.last), run.metrics["dataset"][f"{run.unit}_max"]
    place = "beyond the best" if score > best else "between the two" if score > run.recorded else "not above the mean"
    return f"The {run.number(score)} of {run.label(run.last)} is {place}."


def about_termination(run: Run) -> str:
    """What ends imagined rollouts of a robot whose rule nobody gave."""
    if run.metrics["world_model"]["termination"] != "learned":
        return "No episode of this log terminates, so imagined rollouts end at their horizon alone."
    learned = read_json(run.world_model_folder / "metrics.json")
    recall = learned.get("termination_recall")
    return _joined(
        "No rule is known that says where this robot terminates, so imagined rollouts end where a classifier",
        "learned from the log says so. In held-out episodes it",
        "" if recall is None else f"finds {recall:.0%} of the terminations and",
        f"calls {learned['termination_false_alarms']:.2%} of the other steps one.",
    )


def origin_table(run: Run) -> pd.DataFrame:
    """Who acted in the log, and the return of each without noise; a single row where that is not known."""
    if "policies" not in run.card:
        return pd.DataFrame([{"file": run.card.get("path"), "source": run.card["source"]}])
    rows = [
        {
            "who acted": found["policy"],
            "transitions": f"{found['transitions']:,}",
            "mean return without noise": _or_blank(found["mean_return_deterministic"]),
        }
        for found in run.card["policies"]
    ]
    return pd.DataFrame(rows)


def _or_blank(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f}"


def about_origin(run: Run) -> str:
    """What the source says of its data."""
    return run.card.get("note") or f"Read from source `{run.card['source']}`."


# the world model


def about_training(run: Run) -> str:
    """The world model's size, and the epoch whose weights were kept."""
    curves = pd.read_csv(run.world_model_folder / "curves.csv")
    kept = curves["val/open_loop_error"].notna()
    errors, epochs = (np.asarray(curves.loc[kept, name]) for name in ("val/open_loop_error", "epoch"))
    best = int(errors.argmin())
    return _joined(
        f"{run.metrics['world_model']['parameters']:,} parameters. The open-loop error was {errors[0]:.3g} after",
        f"the first of {int(epochs[-1])} epochs and {errors[best]:.3g} at its least, after epoch {int(epochs[best])},",
        "whose weights were kept.",
        "It was still falling at the end: longer training would help." if 0 < best == len(errors) - 1 else "",
    )


def about_one_step(run: Run) -> str:
    """The one-step error, and a warning where it is none better than the mean's."""
    error = run.metrics["world_model"]["nmse_one_step"]
    return _joined(
        f"The mean squared one-step error is {error:.2g} of a variance: {100 * error**0.5:.1f} % of a standard",
        "deviation.",
        "**That is no better than always predicting the mean: do not trust anything below.**" if error >= 1.0 else "",
    )


def about_calibration(run: Run) -> str:
    """How often outcomes fall into the predicted intervals."""
    found = run.metrics["world_model"]
    return _joined(
        f"The 50 % intervals hold {found['coverage_50']:.0%} of the held-out outcomes, the 90 % intervals",
        f"{found['coverage_90']:.0%}: at 90 % the spread is {_honesty(run)}.",
    )


def _honesty(run: Run) -> str:
    excess = run.metrics["world_model"]["coverage_90"] - 0.9
    if abs(excess) <= 0.05:
        return "about honest"
    return "too wide" if excess > 0 else "too narrow: it is overconfident"


def horizon_table(run: Run) -> pd.DataFrame:
    """Steps within each threshold, open loop and teacher-forced."""
    steps = run.table("horizon_steps")
    shown = {"run": steps["run"], "threshold": steps["threshold"].map("{:g}".format)}
    names = {"mean": "mean steps", "standard_error": "standard error", "median": "median steps"}
    shown |= {name: steps[column].map("{:.1f}".format) for column, name in names.items()}
    return pd.DataFrame(shown | {"never passed it": steps["censored"].map("{:.0%}".format)})


def _steps_alone(run: Run, threshold: float) -> float:
    steps = run.table("horizon_steps")
    return float(steps.loc[(steps["run"] == "open loop") & (steps["threshold"] == threshold), "mean"].iloc[0])


def about_horizon(run: Run) -> str:
    """How long the model stays right on its own."""
    return _joined(
        f"Alone, it stays within an error of 0.01 for **{_steps_alone(run, 0.01):.1f} steps** and within 0.1 for",
        f"{_steps_alone(run, 0.1):.1f}.",
    )


def about_median_episode(run: Run) -> str:
    """How much of the episode in the plot `traces` is shown, and how far the imagination strays from it."""
    traces = run.table("traces")
    strayed = (traces["imagined"] - traces["recorded"]).abs() > (traces["upper"] - traces["lower"]) / 2
    return _joined(
        f"{traces['step'].max()} steps are shown. In {strayed.mean():.0%} of the values the record lies outside the",
        "band, which is of a single step: it does not know how far the imagined state before it has strayed.",
    )


# the imagination


def about_rollouts(run: Run) -> str:
    """How many transitions were imagined, and how their uncertainty changes along a rollout."""
    doubt = run.table("rollout_uncertainty")
    first, last = doubt["median"].iloc[0], doubt["median"].iloc[-1]
    stored = f"{run.metrics['rollouts']['transitions']:,} imagined transitions were stored."
    if len(doubt) == 1:
        return f"{stored} All are one step deep, with a median uncertainty of {first:.2g} standard deviations."
    survivors = doubt["transitions"].iloc[-1] / doubt["transitions"].iloc[0]
    return _joined(
        stored,
        f"At step 1 the median uncertainty is {first:.2g} standard deviations, at step {len(doubt)} it is {last:.2g}:",
        f"it {'grows' if last > 1.05 * first else 'does not grow'} along the rollout.",
        f"{survivors:.0%} of the rollouts come so far.",
    )


# the policies


def about_q(run: Run) -> str:
    """Where each policy's critics ended."""
    curves = {run.label(name): run.policy_curves(name) for name in run.policies}
    final = {label: t["train/q_data"].dropna() for label, t in curves.items() if "train/q_data" in t}
    ends = [f"{values.iloc[-1]:.3g} for {label}" for label, values in final.items() if len(values)]
    if not ends:
        return "None of these policies has critics, so there is no Q to watch."
    return f"At the end the mean Q of the batch is {', '.join(ends)}."


def comparison_table(run: Run) -> pd.DataFrame:
    """The last policy against every other one."""
    rows = []
    for name in run.others:
        found = run.compare(run.last, name)
        error = run.number(found.standard_error) if math.isfinite(found.standard_error) else "unknown"
        words = {"difference": run.number(found.gain, sign="+"), "standard error": error, "verdict": found.verdict}
        rows.append({f"{run.label(run.last)} against": run.label(name)} | words)
    return pd.DataFrame(rows)


def about_imagination(run: Run) -> str:
    """Whether imagination helped: the last policy that imagines against the best from data alone."""
    pair = _imagining_and_not(run)
    if pair is None:
        return "Whether imagination helps is not seen here: that takes a policy that imagines and one that does not."
    found, (imagining, alone) = run.compare(*pair), pair
    error = run.number(found.standard_error) if math.isfinite(found.standard_error) else "unknown"
    also = {"score": ", or than a point,", "return": "", "imagined_return": ", or than the model errs by,"}
    same = run.policies[imagining]["world_model"] == run.metrics["world_model"]["name"]
    return _joined(
        f"Imagination {_effect(run)}: {run.amount(found.gain)} for {run.label(imagining)} against {run.label(alone)},",
        f"the best from data alone. Over these {found.starts} starts the standard error is {error}; less than twice",
        f"that{also[run.measure]} counts as no difference. One training seed stands behind each policy: another seed",
        "may tell otherwise.",
        "**The model that estimates this is the one that the policy was trained in.**"
        if same and not run.simulated
        else "",
    )


def _imagining_and_not(run: Run) -> tuple[str, str] | None:
    imagining = [name for name in run.policies if run.imagines(name)]
    alone = [name for name in run.policies if not run.imagines(name)]
    return (imagining[-1], max(alone, key=run.mean)) if imagining and alone else None


def _effect(run: Run) -> str:
    pair = _imagining_and_not(run)
    assert pair is not None
    words = {"better": "helped", "worse": "**hurt**", "not clearly different": "made no clear difference"}
    return words[run.compare(*pair).verdict]


# what it means


def as_simulator(run: Run) -> str:
    """What the world model is good for on its own."""
    return _joined(
        f"- As a **simulator**, the model can be trusted for about {_steps_alone(run, 0.1):.0f} steps on its own",
        f"(error 0.1); its 90 % intervals are {_honesty(run)}.\n",
    )


def as_experience(run: Run) -> str:
    """What imagined experience did for the policies; nothing where no two can be compared for that."""
    pair = _imagining_and_not(run)
    if pair is None:
        return ""
    gain = run.amount(run.compare(*pair).gain)
    return f"- As a **source of experience**, it {_effect(run)}: {gain} against the best policy from data alone.\n"


def as_policy(run: Run) -> str:
    """What the last policy is worth."""
    gain, last = run.mean(run.last) - run.recorded, run.label(run.last)
    if not run.simulated:
        return (
            f"- As a **policy**, {last} is estimated at {run.amount(gain)} over the recorded episodes, by a model that "
            f"errs by {run.least:.3g} on theirs. Only the robot can tell.\n"
        )
    differences = [
        f"{run.number(run.mean(run.last) - run.mean(name), sign='+')} to {run.label(name)}" for name in run.others
    ]
    against = f"; {', '.join(differences)}" if differences else ""
    better = "better" if gain > 0 else "no better"
    return f"- As a **policy**, {last} is {better} than the data's average ({run.amount(gain)}{against}).\n"


def _joined(*parts: str) -> str:
    return " ".join(part for part in parts if part)
