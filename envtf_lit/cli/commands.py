"""The names of all commands, the line that help has for each, and the module that owns it; imports none of them."""

from typing import NamedTuple

ANEW = "The same command begins anew."


class Command(NamedTuple):
    """A command, as far as it is known without its module.

    Attributes:
        module: of `envtf_lit.cli`; its `run(name, words)` parses the words after the name, and does what they say.
        summary: its line in the help.
        rerun: what the same command does after it was interrupted.
    """

    module: str
    summary: str
    rerun: str = ANEW


_EPOCH = "The same command continues training from the last finished epoch."
_CHECKPOINT = "To go on from the last finished epoch, add --ckpt_path and the newest .ckpt file of this run."
_KEPT = "The same command keeps the models that are trained and measured, and goes on with the others."

COMMANDS = {
    "source": Command("stages", "Note the checksum of a file of yours, so that a changed one is noticed"),
    "download": Command("stages", "Make or read the dataset: data/dataset.h5"),
    "train_model": Command("stages", "Train a world model: models/world_model/NAME/", _EPOCH),
    "generate_rollouts": Command(
        "stages", "Imagine a cloned policy's rollouts in a world model: data/rollouts/NAME.h5"
    ),
    "train_policy": Command("stages", "Train a policy: models/policy/NAME/", _EPOCH),
    "evaluate": Command("stages", "Score policies and model: reports/metrics.json, plots/, video/"),
    "report": Command("stages", "Execute the report notebook: reports/report.ipynb and .html"),
    "model": Command("lightning", "Lightning's command line of the world model: fit, validate, test", _CHECKPOINT),
    "agent": Command("lightning", "Lightning's command line of the agents: fit, validate", _CHECKPOINT),
    "init": Command(
        "project", "Write a new project: dvc.yaml, params.yaml, notebooks", "The same command writes what is missing."
    ),
    "params": Command("project", "Print a complete params.yaml"),
    "tutorial": Command("project", "Execute a tutorial notebook: reports/notebooks/NAME.html"),
    "data check": Command("data", "Print what a dataset holds and every problem in it, each with a fix"),
    "data convert": Command("data", "Write a dataset in another format, and say what was changed or left behind"),
    "zoo list": Command("zoo", "Print the twenty datasets and the policies behind each"),
    "zoo build": Command(
        "zoo",
        "Collect datasets into a folder, with cards, a table and a figure",
        "The same command keeps the datasets that are whole, and collects the others.",
    ),
    "zoo train": Command(
        "zoo",
        "Train behaviour policies (needs the extra `behaviour`)",
        "The snapshots so far are a shorter series; training cannot be continued, and a new one needs another --out.",
    ),
    "zoo settle": Command("zoo", "Exchange a series' last snapshot for the late ones' calmer mean"),
    "hidden": Command("studies", "Measure what memory is worth where friction, mass and strength are hidden", _KEPT),
    "horizon": Command(
        "studies", "Measure how long world models track reality, beside the ceiling that physics sets", _KEPT
    ),
    "calibrate": Command(
        "studies",
        "Measure what world models know of their own errors: coverage, detection of new data, errors of rollouts",
        _KEPT,
    ),
    "narrow": Command(
        "studies",
        "Measure whether policies from logs of machines that were held back do harm, in the true simulator",
        _KEPT,
    ),
    "bench model": Command("studies", "Imagination and training, against ensemble, simulator and matrix product"),
    "bench agents": Command("studies", "The agents' updates on a CPU, against d3rlpy, and without Lightning"),
    "bench cost": Command("studies", "Training to equal held-out error: transformer, ensemble, plain network", _KEPT),
    "bench planning": Command(
        "planning", "Planners on a pendulum: through a model learned from random steps, and through the truth", _KEPT
    ),
    "compare run": Command(
        "comparison",
        "Train and score every algorithm on every task, robot by tier by seed; what is done already stays",
        "The same command goes on with the runs that are not finished.",
    ),
    "compare report": Command("comparison", "Write tables and figures of what compare run has found"),
    "plan": Command("planning", "Play a planner, which searches a world model at each step, in MuJoCo or the model"),
    "export policy": Command("export", "Write a policy as ONNX or torch.export: observation to action"),
    "export model": Command(
        "export", "Write a world model's step as ONNX or torch.export, its cache an input and output"
    ),
    "policy act": Command("export", "Print a policy's actions for observations in a .npy file"),
    "card": Command("sharing", "Write a model's card: data, scores, calibration, limits, versions, licence"),
    "push": Command("sharing", "Send a model and its card to a folder or to the Hugging Face hub"),
    "pull": Command("sharing", "Fetch a model from a folder or from the Hugging Face hub, and check it"),
    "doctor": Command("project", "Print versions, threads, GL, disk and GPU for a bug report"),
}
GROUPS = {
    "data": "Check a dataset, or convert it to another format",
    "zoo": "Datasets of four robots from behaviour policies that come along: list, build, or train your own",
    "export": "Write a policy or a world model as a file that runs without this package",
    "policy": "Ask a policy for actions",
    "compare": "Compare every algorithm on every task, and report it",
    "bench": "Measure the speed of world model and agents and what accuracy costs, beside what they would replace",
}
