"""The one error that a user is meant to read."""

from __future__ import annotations

_MOST = 200


class UserError(Exception):
    """Something that the user can fix: its message is one line that names the thing and the fix.

    The command line prints it to standard error and exits with code 2.
    """


def brief(error: object) -> str:
    """Return what an error says, in one line and cut: a library may quote the whole of a damaged file."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _MOST else f"{text[:_MOST]}..."
