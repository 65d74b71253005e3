"""Every call of `envtf` in README and docs is one that the command line understands."""

import dataclasses
import inspect
import re
import shlex
from collections.abc import Sequence
from importlib import import_module
from itertools import pairwise
from typing import Any

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.cli.commands import COMMANDS, GROUPS
from envtf_lit.cli.lightning_modules import LogTransitions, LogWindows, OnlineTransitions, agent_of, world_model_of
from envtf_lit.cli.signatures import parse_words
from envtf_lit.cli.stages import STAGES, StageParser, split
from envtf_lit.data.datamodules import TransitionData, WindowData
from envtf_lit.online.data import OnlineData
from envtf_lit.pipeline.yaml import load_params
from envtf_lit.world_models.options import KINDS
from tests.test_cli import LIGHTNING
from tests.test_docs import PAGES, ROOT


def documented() -> list[str]:
    """What README and docs call `envtf` with: lines of code blocks, continued ones whole, and code within sentences."""
    found = list[str]()
    for page in PAGES:
        text = re.sub(r"\\\n *", "", page.read_text())
        found += re.findall(r"^ *envtf (.+)$", text, re.MULTILINE) + re.findall(r"`envtf ([^`\n]+)`", text)
    return sorted(dict.fromkeys(found))


def test_every_command_in_the_documentation_is_understood() -> None:
    lines = documented()
    assert len(lines) > 40
    for line in lines:
        words = shlex.split(line.partition(" > ")[0], comments=True)
        if words[0].startswith("-") or (len(words) == 1 and words[0] in GROUPS):
            continue
        name = " ".join(words[:2]) if words[0] in GROUPS else words[0]
        assert name in COMMANDS, line
        rest = words[len(name.split()) :]
        if name in LIGHTNING:
            assert not rest or rest[0] in ("fit", "validate", "test", "--help"), line
            assert lightning_flags(rest) <= known_flags(name, rest), line
        elif name in STAGES:
            own, overrides = split(rest)
            params = load_params(ROOT / "params.yaml", overrides)
            if STAGES[name].named and own != ["--help"]:
                below = params.train_policy if name == "train_policy" else params.train_model
                assert StageParser(name).parse_args(own).name in (None, "NAME", *below), line
        elif rest and "--help" not in rest:
            rest += ["--out", "x"] * (name in ("hidden", "horizon", "calibrate") and "--out" not in rest)
            parse_words(import_module(f"envtf_lit.cli.{COMMANDS[name].module}").FUNCTIONS[name], name, rest)


def lightning_flags(words: Sequence[str]) -> set[str]:
    """Those of ours: Lightning knows its trainer's itself."""
    flags = {word.partition("=")[0] for word in words if word.startswith("--")}
    return {flag for flag in flags if not flag.startswith(("--trainer.", "--help"))}


def known_flags(name: str, words: Sequence[str]) -> set[str]:
    """The flags of `envtf model` or `envtf agent`, of the kind or algorithm that is chosen."""
    tag, classes, default = ("kind", KINDS, "transformer") if name == "model" else ("algorithm", ALGORITHMS, "cql")
    chosen = [after for word, after in pairwise(words) if word == f"--model.{tag}"] or [default]
    cls: Any = classes[chosen[0]]
    model = world_model_of(chosen[0]) if name == "model" else agent_of(chosen[0])
    options = dataclasses.fields(cls if name == "model" else cls.Options)
    data = (WindowData, LogWindows) if name == "model" else (TransitionData, LogTransitions)
    if name == "agent" and "online" in words:
        data = (TransitionData, OnlineData, OnlineTransitions)
    flags = {f"--model.{key}" for key in inspect.signature(model).parameters}
    flags |= {f"--model.options.{field.name}" for field in options}
    flags |= {f"--data.{key}" for reader in data for key in inspect.signature(reader).parameters}
    return flags | {"--config", "--ckpt_path"}
