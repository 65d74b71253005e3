"""The command line, `envtf`: finds the command that is meant, and says in a sentence what stopped it."""

import contextlib
import errno
import os
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from textwrap import fill
from types import FrameType

from envtf_lit.cli.commands import ANEW, COMMANDS, GROUPS
from envtf_lit.errors import DISK_FULL, UserError, did_you_mean

# what a path is to blame for: too long a name, links in a circle, a file where a folder should be, no permission
PLACE = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.EROFS)
HELP = ("-h", "--help")
ABOUT = "From a log of trajectories to a world model, a policy, and the evidence for both"


class Stopped(BaseException):
    """A signal that asks the program to end; not KeyboardInterrupt, which Lightning turns into exit status 1."""

    def __init__(self, number: int) -> None:
        self.number = number


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs `envtf`: exits with 0, with 2 and a sentence for what the user can mend, with 130 or 143 when stopped."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError):  # whatever stands in for it, such as a notebook's
            stream.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]  # not all is UTF-8
    try:
        with _stopping():
            _run(words)
    except UserError as error:
        _fail(str(error), 2)
    except OSError as error:
        if error.errno in DISK_FULL:
            _fail(f"No space left on the disk ({error}): free some and run the same command again.", 2)
        if error.errno not in PLACE or error.filename is None:
            raise
        _fail(f"Cannot use {error.filename!s:.200}: {error.strerror}; choose another place or name.", 2)
    except KeyboardInterrupt:
        _fail(f"Interrupted. {_rerun(words)}", 128 + signal.SIGINT)
    except Stopped as stop:
        _fail(f"Interrupted. {_rerun(words)}", 128 + stop.number)


def _run(words: list[str]) -> None:
    # Lightning's use of an older torch's name helps nobody
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning)
    name, rest = _command(words)
    import_module(f"envtf_lit.cli.{COMMANDS[name].module}").run(name, rest)


def _command(words: list[str]) -> tuple[str, list[str]]:
    """The command's whole name, such as `data check`, and what follows it; or the help, and out."""
    first = {name.split()[0]: command.summary for name, command in COMMANDS.items()}
    name = _choice("envtf", "COMMAND", ABOUT, first | GROUPS, words)
    if name not in GROUPS:
        return name, words[1:]
    verbs = {full.split()[1]: COMMANDS[full].summary for full in COMMANDS if full.split()[0] == name}
    return f"{name} {_choice(f'envtf {name}', 'VERB', GROUPS[name], verbs, words[1:])}", words[2:]


def _choice(program: str, kind: str, summary: str, known: dict[str, str], words: list[str]) -> str:
    if not words or words[0] in HELP:
        print(_help(program, kind, summary, known), file=sys.stdout if words else sys.stderr)
        raise SystemExit(0 if words else 2)
    if words[0] not in known:
        raise UserError(f"`{program}` has no {kind} {words[0]!r}: {did_you_mean(words[0], known)}")
    return words[0]


def _help(program: str, kind: str, summary: str, known: dict[str, str]) -> str:
    width, column = shutil.get_terminal_size().columns - 2, max(map(len, known)) + 6
    lines = [
        fill(text, width, initial_indent=f"    {name}".ljust(column), subsequent_indent=" " * column)
        for name, text in known.items()
    ]
    rest = f"`{program} {kind} --help` explains one."
    return "\n".join([f"usage: {program} {kind} …", "", f"{summary}.", rest, "", f"{kind} is one of", *lines])


def _rerun(words: list[str]) -> str:
    known = [words[:2], words[:1]]
    return next((COMMANDS[" ".join(name)].rerun for name in known if " ".join(name) in COMMANDS), ANEW)


@contextlib.contextmanager
def _stopping() -> Iterator[None]:
    """While it lasts, SIGINT and SIGTERM raise `Stopped`, so that files are closed and put away as after an error."""
    if threading.current_thread() is not threading.main_thread():  # where Python allows no handlers
        yield
        return
    process = os.getpid()

    def stop(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:  # a forked worker: its pool ends it in its own way
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
            signal.raise_signal(number)
        if "multiprocessing" in sys.modules:  # a pool would wait for all that its workers have begun
            for worker in sys.modules["multiprocessing"].active_children():
                worker.terminate()
        raise Stopped(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _fail(sentence: str, status: int) -> None:
    from envtf_lit.cli.output import console

    console(stderr=True).print(f"envtf: {sentence}", style="red")
    raise SystemExit(status)
