"""What commands share in talking to people and to programs."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box
from psiamfcpp.watch import Watch

# Standard output is for results; what is said on the way goes to standard error.
notes = Console(stderr=True, highlight=False, soft_wrap=True)


def print_json(result: dict[str, Any]) -> None:
    """One JSON object on standard output."""
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


def progress() -> Progress:
    """A progress bar on standard error; nothing where that is no terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=notes, transient=True, disable=not sys.stderr.isatty())


@contextlib.contextmanager
def watching() -> Iterator[Watch]:
    """What recipes tell of their progress, on standard error."""
    with progress() as bar:
        yield Watch(
            notes.print, lambda items, description, total=None: bar.track(items, total=total, description=description)
        )


def parse_box(text: str) -> Box:
    """A box given as ``x,y,w,h``.

    Raises:
        UserError: not four numbers.
    """
    try:
        x, y, w, h = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"box {text!r} is not x,y,w,h: four numbers, parted by commas") from None
    return (x, y, w, h)
