"""`envtf export` writes what runs elsewhere; `envtf policy act` asks a policy for actions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from envtf_lit.cli.output import console
from envtf_lit.cli.signatures import File, Folder, run_command
from envtf_lit.errors import UserError

Saved = Annotated[Path, "FOLDER"]
Out = Annotated[Path, "OUT"]


def export_policy(folder: Saved, out: Out, /) -> None:
    """Writes a policy as one file: observation and noise to action, mean and log_std.

    Args:
        folder: of a policy, such as models/policy/et_cql.
        out: a new file ending in .onnx or .pt2.
    """
    from envtf_lit import export
    from envtf_lit.policy import load_policy

    export.export_policy(load_policy(folder), out)
    console().print(f"Wrote {out}: its actions are PyTorch's, to {export.TOLERANCE:g}")


def export_model(folder: Saved, out: Out, /) -> None:
    """Writes one step of a world model as one file, its cache and clock among inputs and outputs.

    Args:
        folder: of a world model, such as models/world_model/transformer.
        out: a new file ending in .onnx or .pt2.
    """
    from envtf_lit import export
    from envtf_lit.world_models.store import load_world_model

    export.export_world_model(load_world_model(folder), out)
    console().print(f"Wrote {out}: its steps are PyTorch's, to {export.TOLERANCE:g}")


def act(*, policy: Folder, observation: File, out: File | None = None) -> None:
    """Prints a policy's deterministic actions as JSON, or writes them as an array.

    Args:
        policy: folder of a policy.
        observation: a .npy file of one observation (S,), or of several (B, S).
        out: a new .npy file for the actions, (A,) or (B, A).
    """
    import numpy as np
    import torch

    from envtf_lit.export import read_observations
    from envtf_lit.files import replacing
    from envtf_lit.policy import load_policy

    actor = load_policy(policy)
    observations = read_observations(observation, len(actor.observation_mean))
    actions = actor.act(torch.as_tensor(np.atleast_2d(observations))).numpy()
    actions = actions.reshape(*observations.shape[:-1], -1)
    if out is None:
        console().print_json(data=actions.tolist())
        return
    if out.suffix != ".npy" or out.exists():
        raise UserError(
            f"{out} {'exists already' if out.exists() else 'is no .npy file'}: name a new one, such as a.npy."
        )
    with replacing(out) as temporary, temporary.open("wb") as stream:
        np.save(stream, actions, allow_pickle=False)
    console().print(f"Wrote {out}")


FUNCTIONS = {"export policy": export_policy, "export model": export_model, "policy act": act}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf export policy`, `envtf export model` or `envtf policy act`."""
    run_command(FUNCTIONS[name], name, words)
