"""A command is a function: its parameters are the arguments, their types the checks, its docstring the help.

Positional-only parameters, and `*parameter`, are words in their order; all others are flags. jsonargparse parses and
checks; its `add_function_arguments` would want `--quiet true` and `--robots [hopper,ant]`, so the arguments are added
one by one: `--quiet` alone sets what is false by default, a list of choices or numbers takes several words, a list of
text is a flag that may be repeated. Neither files nor the environment set anything, and no type here names a class to
make.
"""

import argparse
import inspect
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, Union, get_args, get_origin, get_type_hints

from docstring_parser import parse
from jsonargparse import ArgumentParser
from jsonargparse.typing import NonNegativeInt, PositiveInt

from envtf_lit.cli.commands import COMMANDS
from envtf_lit.errors import UserError, did_you_mean

Natural = Annotated[int, NonNegativeInt, "N"]
Positive = Annotated[int, PositiveInt, "N"]
File = Annotated[Path, "FILE"]
Folder = Annotated[Path, "DIR"]
Robot = Literal["hopper", "halfcheetah", "walker2d", "ant"]  # written out: to import what knows them takes a second
CORES = os.cpu_count() or 1

WORDS = {
    NonNegativeInt: "a whole number, 0 or more",
    PositiveInt: "a whole number above 0",
    int: "a whole number",
    float: "a finite number",
}


class Argument(NamedTuple):
    """One word or flag of a command.

    Attributes:
        name: of the parameter.
        type: of one value, without `| None` and without what makes a list.
        many: it takes several values.
        metavar: what stands for a value in the help, such as FILE.
        default: `inspect.Parameter.empty` where a value must be given.
        meaning: from the docstring.
        place: inspect's kind of parameter.
    """

    name: str
    type: Any
    many: bool
    metavar: str | None
    default: Any
    meaning: str
    place: Any = inspect.Parameter.KEYWORD_ONLY

    @property
    def written(self) -> str:
        """As the command line has it: the flag, or what stands for the word."""
        if self.place is inspect.Parameter.KEYWORD_ONLY:
            return f"--{self.name.replace('_', '-')}"
        return self.metavar or self.name.upper()

    @property
    def choices(self) -> tuple[str, ...]:
        """All values there are, or nothing where there is no end of them."""
        return get_args(self.type) if get_origin(self.type) is Literal else ()


def run_command(function: Callable[..., None], name: str, words: Sequence[str]) -> None:
    """Calls a function with what a command line says; see `parse_words`."""
    positional, named = parse_words(function, name, words)
    function(*positional, **named)


def parse_words(function: Callable[..., None], name: str, words: Sequence[str]) -> tuple[list[Any], dict[str, Any]]:
    """The arguments of a function that a command line says.

    Args:
        function: typed, with a docstring; parameters whose type is a dataclass stand for its fields.
        name: of the command, such as `data check`.
        words: the command line after it.

    Returns:
        Positional and named ones.

    Raises:
        UserError: a word or flag that the function has no parameter for, a missing one, or a value out of range.
    """
    parser = _Parser(f"envtf {name}", COMMANDS[name].summary, list(arguments(function)), words)
    values = vars(parser.parse_args(list(words), env=False))
    given, named = [], {}
    for parameter in inspect.signature(function).parameters.values():
        if is_dataclass(parameter.default):
            flags = {field.name: values[field.name] for field in fields(parameter.default)}
            named[parameter.name] = replace(parameter.default, **flags)  # pyright: ignore[reportArgumentType]
        elif parameter.kind is parameter.VAR_POSITIONAL:
            given += values[parameter.name]
        elif parameter.kind is parameter.POSITIONAL_ONLY:
            given.append(values[parameter.name])
        else:
            value = values[parameter.name]
            named[parameter.name] = tuple(value) if isinstance(value, list) else value
    return given, named


def arguments(function: Callable[..., None]) -> Iterator[Argument]:
    """The words and flags of a command, those of dataclasses among them."""
    hints, meanings = get_type_hints(function, include_extras=True), _meanings(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if is_dataclass(parameter.default):
            cls: Any = type(parameter.default)
            inner, meant = get_type_hints(cls, include_extras=True), _meanings(cls)
            for field in fields(cls):
                default = getattr(parameter.default, field.name)
                yield Argument(field.name, *_value(inner[field.name]), default, meant[field.name])
        else:
            many = () if parameter.kind is parameter.VAR_POSITIONAL else None
            default = parameter.default if many is None else many
            yield Argument(name, *_value(hints[name]), default, meanings[name], parameter.kind)


def _value(hint: Any) -> tuple[Any, bool, str | None]:
    """(type of one value, whether there are many, metavar) of a type as it is written."""
    if get_origin(hint) in (Union, UnionType):  # None is what it is where nothing is given: no value says it
        hint = next(inner for inner in get_args(hint) if inner is not type(None))
    marks = hint.__metadata__ if get_origin(hint) is Annotated else ()
    hint = get_args(hint)[0] if marks else hint
    many = get_origin(hint) is tuple
    kind = next((mark for mark in marks if isinstance(mark, type)), get_args(hint)[0] if many else hint)
    choices = f"{{{','.join(get_args(kind))}}}" if get_origin(kind) is Literal else None
    return kind, many, next((mark for mark in marks if isinstance(mark, str)), choices)


def _meanings(thing: Callable[..., object]) -> dict[str, str]:
    return {p.arg_name: " ".join((p.description or "").split()) for p in parse(thing.__doc__ or "").params}


class _Parser(ArgumentParser):
    def __init__(self, program: str, summary: str, known: list[Argument], words: Sequence[str]) -> None:
        self.known, self.words = {argument.name: argument for argument in known}, words
        super().__init__(
            prog=program, description=f"{summary}.", formatter_class=argparse.HelpFormatter, allow_abbrev=False
        )
        for argument in known:
            self._add(argument)

    def _add(self, argument: Argument) -> None:
        meaning = argument.meaning.rstrip(".").replace("%", "%%")
        options: dict[str, Any] = dict(metavar=argument.metavar, type=argument.type)
        if argument.place is inspect.Parameter.VAR_POSITIONAL:
            self.add_argument(argument.name, nargs="*", help=meaning, **options)
        elif argument.place is inspect.Parameter.POSITIONAL_ONLY:
            self.add_argument(argument.name, help=meaning, **options)
        else:
            required = argument.default is inspect.Parameter.empty
            options |= {"dest": argument.name, "default": None if required else argument.default}
            options["help"] = f"{meaning}{'; required' if required else _shown(argument.default)}"
            if argument.type is bool:
                options = {name: options[name] for name in ("dest", "default", "help")} | {"action": "store_true"}
            elif argument.many and argument.type is not str:
                options |= {"nargs": "+", "default": argument.default and list(argument.default)}
            elif argument.many:
                del options["type"]  # text as it is
                options |= {"action": "append", "default": []}
            self.add_argument(argument.written, required=required, **options)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Says it in our words, where jsonargparse prints the usage and speaks of types.

        Raises:
            UserError: always.
        """
        key, unknown = re.search(r'Parser key "(\w+)"', message), re.search(r"unrecognized arguments: (\S+)", message)
        missing = re.search(r"are required: (.*)", message)
        if key and key[1] in self.known:
            raise UserError(self._refusal(self.known[key[1]])) from None
        if unknown:
            flags = [argument.written for argument in self.known.values() if argument.written.startswith("--")]
            cure = f": {did_you_mean(unknown[1], flags)}" if flags else ", which takes none."
            raise UserError(f"{unknown[1]!r} is not an option of `{self.prog}`{cure}") from None
        if missing:
            names = [self.known[name].written for name in missing[1].split(", ") if name in self.known]
            message = f"{' and '.join(names) or missing[1]} is missing"
        raise UserError(f"{message[0].upper()}{message[1:]} (see `{self.prog} --help`).") from None

    def _refusal(self, argument: Argument) -> str:
        given = self._given(argument.written)
        if argument.choices:
            wrong = next((word for word in given if word not in argument.choices), "")
            return f"{argument.written} {wrong!r} is unknown: {did_you_mean(wrong, argument.choices)}"
        return f"{argument.written} {' '.join(given)!r} is out of range: give {WORDS[argument.type]}."

    def _given(self, flag: str) -> list[str]:
        """The values that stand after a flag."""
        found, inside = list[str](), False
        for word in self.words:
            if word.startswith("--"):
                inside = word.partition("=")[0] == flag
                found = found if not inside else [word.partition("=")[2]] if "=" in word else []
            elif inside:
                found.append(word)
        return found


def _shown(default: Any) -> str:
    if default is None or default is False or default == ():
        return ""
    if isinstance(default, int) and default >= 10_000:
        return f"; default: {default:,}"
    return f"; default: {' '.join(default) if isinstance(default, tuple) else default}"
