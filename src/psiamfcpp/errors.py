"""The one error that a user is meant to read."""

from __future__ import annotations


class UserError(Exception):
    """Something that the user can fix: its message is one line that names the thing and the fix.

    The command line prints it to standard error and exits with code 2.
    """
