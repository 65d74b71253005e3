"""The one exception that users are meant to read, and sentences that several raise or end it with."""

import difflib
import errno
from collections.abc import Iterable

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no space, none left in the quota, above the size limit


class UserError(ValueError):
    """Something the user can mend: one sentence saying what was wrong, the value, and what to do.

    The command line prints it without a traceback and exits with status 2.
    """


def missing_extra(needed: str, extra: str, error: ImportError) -> UserError:
    """What to raise where an optional package is not installed.

    Args:
        needed: such as "The report needs papermill".
        extra: of envtf-lit, that brings it.
        error: that its import raised.
    """
    return UserError(f"{needed} ({error}): pip install 'envtf-lit[{extra}]'.")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The nearest of `known` to `name` as a hint, else the whole list."""
    options = sorted(known)
    near = difflib.get_close_matches(name, options, n=1, cutoff=0.6)
    return f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(options)}"
