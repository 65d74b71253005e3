"""`envtf card`, `envtf push` and `envtf pull`: models that travel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from envtf_lit.cli.output import console
from envtf_lit.cli.signatures import File, run_command

Saved = Annotated[Path, "FOLDER"]
Target = Annotated[str, "TARGET"]
Source = Annotated[str, "SOURCE"]
REPORT = Path("reports/metrics.json")


def card(folder: Saved, /, *, report: File = REPORT, licence: str = "unknown") -> None:
    """Writes a model's card, README.md, into its folder.

    Args:
        folder: of a policy or a world model.
        report: metrics of the project's evaluation, where there is one.
        licence: as the Hugging Face hub names it, such as mit.
    """
    from envtf_lit.errors import UserError
    from envtf_lit.files import write_text
    from envtf_lit.model_card import model_card
    from envtf_lit.sharing import CARD

    text = model_card(folder, report=report, licence=licence)
    if (folder / CARD).exists():
        raise UserError(f"{folder / CARD} exists already: delete it for a new card.")
    write_text(folder / CARD, text)
    console().print(f"Wrote {folder / CARD}")


def push(
    folder: Saved, target: Target, /, *, report: File = REPORT, licence: str = "unknown", private: bool = False
) -> None:
    """Sends a model and its card to a folder or to the Hugging Face hub.

    Args:
        folder: of a policy or a world model.
        target: a new folder, such as one on a mounted remote, or hf:user/name.
        report: metrics of the project's evaluation, for a card where the folder has none.
        licence: of that card.
        private: a repository that is made on the hub is seen by its owner alone.
    """
    from envtf_lit import sharing
    from envtf_lit.model_card import model_card

    sharing.push(folder, target, lambda path: model_card(path, report=report, licence=licence), private=private)
    console().print(f"Pushed {folder} to {target}")


def pull(source: Source, folder: Saved, /) -> None:
    """Fetches a model: safetensors and JSON, loaded before they take their place.

    Args:
        source: a folder, or hf:user/name.
        folder: a new one.
    """
    from envtf_lit import sharing

    model = sharing.pull(source, folder)
    console().print(f"Pulled {type(model).__name__} from {source}: {folder}")


FUNCTIONS = {"card": card, "push": push, "pull": pull}


def run(name: str, words: Sequence[str]) -> None:
    """Runs `envtf card`, `envtf push` or `envtf pull`."""
    run_command(FUNCTIONS[name], name, words)
