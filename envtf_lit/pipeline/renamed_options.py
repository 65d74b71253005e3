"""Options of earlier versions: yesterday's params.yaml is refused with a sentence that leads on."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from envtf_lit.errors import UserError
from envtf_lit.world_models.options import TransformerOptions

GONE = ""
BESIDE = "the policy's own real_ratio, refresh_every, rollouts and value_gradient"
# Where each stands now, by its old key; CHANGELOG.md has the same as a table. `*` is a policy.
FORMER = {
    "train_model.model": "train_model.transformer",
    "train_model.ensemble": "a section of its own below train_model, with `kind: ensemble`",
    "train_model.held_out": "download.held_out",
    **{f"train_model.{field.name}": f"train_model.transformer.{field.name}" for field in fields(TransformerOptions)},
    "generate_rollouts.clone_updates": "train_policy.bc.updates",
    "generate_rollouts.clone_batch_size": "train_policy.bc.batch_size",
    "generate_rollouts.share": GONE,
    "generate_rollouts.mode": GONE,
    "train_policy.*.imagination": BESIDE,
    "train_policy.*.temperature": GONE,
    "train_policy.*.critics": GONE,
    "train_policy.*.initial_alpha": GONE,
    "train_policy.*.updates_per_step": GONE,
    "train_policy.*.warm_start_learning_rate": GONE,
}


def refuse_former(values: Mapping[str, Any]) -> None:
    """Whatever else may be wrong with it, a file of an earlier version is called that.

    Raises:
        UserError: an option stands where it stood once.
    """
    for key, known in _keys(values):
        if known in FORMER:
            now = f"it is {FORMER[known]} now" if FORMER[known] else "it is gone"
            raise UserError(
                f"{key} is an option of an earlier version; {now}: `envtf params` prints today's file, `envtf init` "
                "writes it and its dvc.yaml to a new folder, and CHANGELOG.md lists what moved."
            )


def _keys(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """(key, key in `FORMER`) of what a stage holds; a section below train_model that has a kind is of today."""
    for stage, below in values.items():
        for name, value in below.items() if isinstance(below, Mapping) else ():
            inner = value if isinstance(value, Mapping) else {}
            if "kind" not in inner:
                yield f"{stage}.{name}", f"{stage}.{name}"
            for key in inner if stage == "train_policy" else ():
                yield f"{stage}.{name}.{key}", f"{stage}.*.{key}"
