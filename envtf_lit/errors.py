"""The one exception that users are meant to read, and the "did you mean" that goes with it."""

import difflib
import errno
from collections.abc import Iterable

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no space, none left in the quota, above the size limit


class UserError(ValueError):
    """Something the user can mend: one sentence saying what was wrong, the value, and what to do.

    The command line prints it without a traceback and exits with status 2.
    """


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The nearest of `known` to `name` as a hint, else the whole list."""
    options = sorted(known)
    near = difflib.get_close_matches(name, options, n=1, cutoff=0.6)
    return f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(options)}"
