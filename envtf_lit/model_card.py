"""A trained model's card: what it is, what it learned from, how good it is, and what not to ask of it."""

import json
import math
from importlib.metadata import version
from pathlib import Path
from typing import Any

from envtf_lit.actors import Actor, kind_of
from envtf_lit.critics import CRITICS
from envtf_lit.errors import UserError
from envtf_lit.files import read_json
from envtf_lit.sharing import Model, load_model
from envtf_lit.world_models.transformer import EnvironmentTransformer

UNKNOWN = "unknown"  # the hub's word for a licence that nobody stated
WHAT = {
    "tanh_gaussian": "A stochastic policy, a squashed Gaussian, learned from a log of trajectories.",
    "gaussian": "A stochastic policy, a Gaussian with a mean in the action space, learned from a log of trajectories.",
    "deterministic": "A deterministic policy, learned from a log of trajectories.",
    "environment_transformer": "A world model: a transformer that predicts next state and reward, and its uncertainty.",
    "ensemble_dynamics": "A world model: an ensemble that predicts next state and reward, and its uncertainty.",
}

GLOSSARY = (
    "Formulas, and numbers that no line explains: `docs/metrics.md`, Metrics, in the documentation of envtf_lit. Q and "
    "losses of policies are in standard deviations of the log's returns, unless the settings say "
    "`normalise_returns: false`."
)
SCALE = "0 is a random policy, 100 D4RL's expert"
# what a number is, and where it should lie
DATA_MEANS = {
    "task": "the robot, and which policies recorded it",
    "transitions": "recorded steps",
    "episodes": "recorded episodes",
    "score_mean": f"of the recorded episodes; {SCALE}",
    "score_max": "the best recorded episode's",
    "return_mean": "sum of an episode's rewards, mean over the recorded ones",
    "return_max": "the best recorded episode's",
}
POLICY_MEANS = {
    "score_mean": f"of its episodes in MuJoCo; {SCALE}; healthy: above the data's",
    "score_std": "spread over episodes, not over seeds",
    "return_mean": "sum of an episode's rewards in MuJoCo, mean over episodes",
    "return_std": "spread over episodes",
    "episodes": "that were played",
    "effective_episodes": "recorded episodes that it learned from, each counted by its share; healthy: dozens",
    "clone_return_mean": "return_mean of the clone that it began from; healthy: less than its own",
    "imagined_return_mean": "sum of an episode's rewards in the world model, whose opinion it is: nobody measured it",
    "imagined_return_std": "spread over episodes",
    "action_error": "squared distance from held-out actions over their variance; 0 copies them, 1 is the mean action's",
    "epoch": "of training, as are all numbers below",
    "clone_loss": "-log-likelihood of recorded actions, per dimension; less is nearer to the log",
    "held_out_clone_loss": "the same of episodes that it did not learn from; healthy: near clone_loss",
    "bellman_loss": "squared error of Q against its targets; healthy: small beside Q squared",
    "conservative_gap": "by how much Q prefers actions that the log lacks; healthy: below 0, or falling",
    "q_data": "mean Q of recorded actions; healthy: level",
    "q_target": "mean of what Q is fitted to; healthy: level",
    "q_policy": "mean Q of its own actions; healthy: not far above q_data",
    "entropy": "of its actions; healthy: near -(number of action dimensions)",
    "alpha": "weight of the entropy; healthy: level",
    "imagined_value": "discounted return of the imagined paths that it was improved on, in the log's rewards",
    "trust_weight": "what holds it to the log; healthy: 0.01 to 1, and below its bound of 100",
    "cut_share": "share of imagined paths that left what the world model knows; healthy: small, 1 is all of them",
}
MODEL_MEANS = {
    "parameters": "numbers that were learned",
    "epoch": "of training whose weights these are",
    "open_loop_error": "of held-out stretches, fed its own predictions: squared error over the data's variance",
    "val_loss": "training's objective on held-out episodes; it need not fall while errors do",
    "open_loop_0.1_median": "reach: steps within which half of the held-out stretches keep an error below 0.1; to 100",
    "termination_recall": "share of held-out terminations that are found; healthy: above 0.8",
    "termination_false_alarms": "share of other steps called one; healthy: far below one in an episode's length",
    "nmse_one_step": "squared error one step ahead over the data's variance; healthy: below 0.01, 1 is the mean's",
    "coverage_50": "share of outcomes in its 50 % intervals; healthy: near 0.50, less is overconfident",
    "coverage_90": "share of outcomes in its 90 % intervals; healthy: near 0.90, less is overconfident",
    "open_loop_steps_0.01": "mean steps before the error passes 0.01, fed its own predictions; more is better",
    "teacher_forced_steps_0.01": "the same, shown the true state before every step; healthy: above the former",
}


def model_card(folder: str | Path, *, report: str | Path | None = None, licence: str = UNKNOWN) -> str:
    """The text of a model's card, with the hub's front matter.

    Args:
        folder: of a policy or a world model, whose `metrics.json` and `resolved.json` are read where there are such.
        report: `reports/metrics.json` of the project; scores and calibration are of the model of the folder's name.
        licence: the hub's name of it, such as `mit`.

    Raises:
        UserError: the folder holds no model, a file is not JSON, or the licence is no such name.
    """
    folder = Path(folder)
    if not licence or not all(character.isalnum() or character in ".-" for character in licence):
        raise UserError(f"{licence!r} names no licence: write it as the hub does, such as mit or apache-2.0.")
    model, name = load_model(folder), folder.resolve().name
    kind = kind_of(model) if isinstance(model, Actor) else str(read_json(folder / "config.json")["kind"])
    found, means = _record(report), POLICY_MEANS if isinstance(model, Actor) else MODEL_MEANS
    tags = [
        "reinforcement-learning",
        "offline-reinforcement-learning",
        *([] if isinstance(model, Actor) else ["world-model"]),
    ]
    front = {"library_name": "envtf_lit", "pipeline_tag": "reinforcement-learning", "license": licence, "tags": tags}
    parts = [
        "---\n" + "\n".join(f"{key}: {json.dumps(value)}" for key, value in front.items()) + "\n---",
        f"# {name}\n\n{WHAT[kind]}",
        f"```python\nimport envtf_lit\n\n{_use(model, folder)}\n```",
        *_section("Data", _data(found), DATA_MEANS),
        *_section("Scores", _scores(model, name, found) | _numbers(_record(folder / "metrics.json")), means),
        *([] if isinstance(model, Actor) else _section("Calibration", _calibration(name, found), means)),
        GLOSSARY,
        f"## Limits\n\n{_limits(model)}",
        *_options(_record(folder / "resolved.json")),
        *_section("Versions", {package: version(package) for package in ("envtf-lit", "torch")}, {}),
        "## Licence\n\n" + ("None was stated: ask whoever trained it." if licence == UNKNOWN else f"`{licence}`"),
    ]
    return "\n\n".join(parts) + "\n"


def _record(path: str | Path | None) -> dict[str, Any]:
    """A JSON object, empty where there is no file."""
    content = read_json(path) if path is not None and Path(path).is_file() else {}
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no JSON object: write it anew.")
    return content


def _part(record: dict[str, Any], *names: str) -> dict[str, Any]:
    for name in names:
        inner = record.get(name)
        record = inner if isinstance(inner, dict) else {}
    return record


def _numbers(record: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value
        for name, value in record.items()
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    }


def _data(found: dict[str, Any]) -> dict[str, Any]:
    task = found.get("task")
    return ({"task": task} if isinstance(task, str) else {}) | _numbers(_part(found, "dataset"))


def _scores(model: Model, name: str, found: dict[str, Any]) -> dict[str, Any]:
    return _numbers(_part(found, "policies", name)) if isinstance(model, Actor) else {}


def _calibration(name: str, found: dict[str, Any]) -> dict[str, Any]:
    scored = _part(found, "world_model")
    return _numbers(scored) if scored.get("name") == name else {}


def _section(title: str, facts: dict[str, Any], means: dict[str, str]) -> list[str]:
    if not facts:
        return [f"## {title}\n\nNot recorded beside this model."]
    lines = [f"| {_cell(key)} | {_cell(value)} | {means.get(key, '')} |" for key, value in facts.items()]
    return ["\n".join([f"## {title}\n", "| | | |", "|---|---|---|", *lines])]


def _cell(value: Any) -> str:
    """A number to four digits; text without what would end a cell, or begin a link or HTML."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "".join(character for character in str(value)[:100] if character.isalnum() or character in " _.,:+-/%")


def _options(settings: dict[str, Any]) -> list[str]:
    if not settings:
        return []
    text = json.dumps(settings, indent=2).replace("```", "")
    return [f"## Settings\n\n```json\n{text}\n```"]


def _use(model: Model, folder: Path) -> str:
    if isinstance(model, Actor):
        lines = ['policy = envtf_lit.load_policy("FOLDER")', "action = policy.act(observation)  # (B, S) to (B, A)"]
        if (folder / CRITICS).is_dir():
            lines.append('value = envtf_lit.load_critics("FOLDER").value(observation)  # (B,), of discounted rewards')
        return "\n".join(lines)
    return (
        'model = envtf_lit.load_world_model("FOLDER")\n'
        "state = model.init(observations, actions, lengths)  # (B, T, S), (B, T - 1, A), (B,): seen and done so far\n"
        "state, prediction = model.step(state, action)  # (B, A)"
    )


def _limits(model: Model) -> str:
    if isinstance(model, Actor):
        S, A = len(model.observation_mean), len(model.action_low)
        low, high = ([round(x, 6) for x in limit.tolist()] for limit in (model.action_low, model.action_high))
        return (
            f"{S} observation and {A} action dimensions; actions from {low} to {high}. It knows the states of its log: "
            "elsewhere its actions are extrapolation, and nothing in it says so. Try it in a simulator, or within the "
            "limits of a safety layer, before a robot obeys it."
        )
    memory = f"It sees the last {model.options.context} steps. " if isinstance(model, EnvironmentTransformer) else ""
    return (
        f"{model.observation_dim} observation and {model.action_dim} action dimensions. {memory}Predictions hold where "
        "data were: a `novelty` above 1 says that they were not, and rollouts should end there. Errors add up over an "
        "open loop."
    )
