"""The stages of the pipeline, each a command that reads params.yaml and the overrides behind it."""

import argparse
import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from textwrap import fill
from typing import NamedTuple, NoReturn

from envtf_lit.cli.commands import COMMANDS
from envtf_lit.cli.output import console, hush_lightning
from envtf_lit.errors import UserError


class Stage(NamedTuple):
    """What one stage's command has that others have not.

    Attributes:
        sections: the parts of params.yaml that its help explains.
        named: whether a word after its name says which section below the stage is meant; the stage checks the word.
    """

    sections: tuple[str, ...] = ()
    named: bool = False


STAGES = {
    "source": Stage(("download",)),
    "download": Stage(("download",)),
    "train_model": Stage(("train_model",), named=True),
    "generate_rollouts": Stage(("generate_rollouts",), named=True),
    "train_policy": Stage(("policy", "train_policy"), named=True),
    "evaluate": Stage(("evaluate",)),
    "report": Stage(),
}
GLOBAL_OPTIONS = ("task", "seed", "threads", "precision", "compile")
OWN = ("--help", "--params", "--quiet")


def run(name: str, words: Sequence[str]) -> None:
    """Runs a stage of the pipeline in the current folder, and prints its metrics as JSON.

    Raises:
        UserError: a word that is no option, or what the stage refuses.
    """
    own, overrides = split(words)
    options = StageParser(name).parse_args(own)
    from envtf_lit.pipeline.yaml import load_params

    params = load_params(options.params, overrides)
    hush_lightning()
    os.environ.pop("MUJOCO_GL", None)  # a back end that is missing breaks `import mujoco`; videos probe for their own
    stage = getattr(import_module(f"envtf_lit.pipeline.{name}"), name)
    section = {"name": options.name} if STAGES[name].named else {}
    metrics = stage(params, **section, progress=not options.quiet)
    console().print_json(data=metrics)
    if overrides and Path("dvc.yaml").exists():
        console(stderr=True).print(
            f"params.yaml does not say {' '.join(overrides)}: the next `dvc repro` puts back what it does say. Write "
            "it there, or use `dvc exp run -S`."
        )


class StageParser(argparse.ArgumentParser):
    """Of a stage's own words alone: its options are those of params.yaml, which know their types themselves."""

    def __init__(self, name: str) -> None:
        super().__init__(f"envtf {name}", description=f"{COMMANDS[name].summary}.", allow_abbrev=False)
        self.stage = STAGES[name]
        if self.stage.named:
            below = "train_model" if name == "generate_rollouts" else name
            self.add_argument("name", nargs="?", help=f"of a section of params.yaml below {below}; needed if several")
        self.add_argument("--params", default="params.yaml", metavar="FILE", help="default: params.yaml")
        self.add_argument("--quiet", action="store_true", help="no progress bars")

    def format_help(self) -> str:
        """With all options of params.yaml, which take too long to read for another command."""
        from envtf_lit.pipeline.yaml import describe

        lines = ["", "options of params.yaml, each also a flag, such as --seed 1 or --policy.updates=9000:"]
        for option in (option for part in (*GLOBAL_OPTIONS, *self.stage.sections) for option in describe(part)):
            default = "null" if option.default is None else option.default
            lines.append(f"  --{option.key}  ({option.kind}, default {default})")
            lines.append(fill(option.meaning, 110, initial_indent=" " * 8, subsequent_indent=" " * 8))
        return super().format_help() + "\n".join(lines) + "\n"

    def error(self, message: str) -> NoReturn:
        """Says it in a sentence alone.

        Raises:
            UserError: always.
        """
        what, _, words = message.partition(": ")
        if what == "unrecognized arguments":
            raise UserError(
                f"{words.split()[0]!r} is not an option: write --section.key value, such as --policy.updates 9000."
            )
        raise UserError(f"{message[0].upper()}{message[1:]} (see `{self.prog} --help`).")


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """(the words that every stage has, the overrides of params.yaml: `--a.b 1` and `--a.b=1` as `a.b=1`).

    Raises:
        UserError: a flag without its value.
    """
    own, overrides, waiting = list[str](), list[str](), None
    for word in words:
        if waiting is not None:
            if word.startswith("--"):
                break
            overrides.append(f"{waiting}={word}")
            waiting = None
        elif not word.startswith("--") or word.partition("=")[0] in OWN:
            own.append(word)
        elif "=" in word:
            overrides.append(word[2:])
        else:
            waiting = word[2:]
    if waiting is not None:
        raise UserError(f"--{waiting} needs a value.")
    return own, overrides
