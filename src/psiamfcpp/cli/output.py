"""What commands share in talking to people and to programs."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Box
from psiamfcpp.video.writer import writes_h264
from psiamfcpp.watch import Item, Watch

LINE_SECONDS = 10.0
"""between two lines of progress; what is done sooner prints none"""

# Standard output is for results; what is said on the way goes to standard error.
# Without markup, since names of files and of extras may hold brackets.
notes = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)


def print_json(result: dict[str, Any]) -> None:
    """One JSON object on standard output."""
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")


def _lines(items: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Go over items, and print a line every `LINE_SECONDS` about how many are done."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    start = said = time.monotonic()
    for done, item in enumerate(items, start=1):
        now = time.monotonic()
        if now - said >= LINE_SECONDS:
            left = f", about {(now - start) / done * (total - done):.0f} s left" if total else ""
            notes.print(f"{description}: {done}{f' of {total}' if total else ''}, {now - start:.0f} s{left}")
            said = now
        yield item


def progress() -> Progress:
    """A progress bar on standard error; nothing where that is no terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=notes, transient=True, disable=not sys.stderr.isatty())


@contextlib.contextmanager
def watching() -> Iterator[Watch]:
    """Give recipes a place for their progress on standard error: a bar, or lines where that is no terminal."""
    if not sys.stderr.isatty():
        yield Watch(notes.print, _lines)
        return
    with progress() as bar:
        yield Watch(
            notes.print, lambda items, description, total=None: bar.track(items, total=total, description=description)
        )


def check_new(outputs: Iterable[Path | None], overwrite: bool) -> None:
    """Refuse outputs that exist already, and folders that hold something; None is passed over.

    Raises:
        UserError: names the first of them.
    """
    for path in (path for path in outputs if path is not None and not overwrite):
        if path.is_dir() and any(path.iterdir()):
            raise UserError(f"output folder {path} is not empty: choose another, or give --overwrite")
        if path.exists() and not path.is_dir():
            raise UserError(f"output {path} exists already: choose another name, or give --overwrite")


def say_of_video() -> None:
    """Say what a video cannot be played by, where it is not written as H.264."""
    if not writes_h264():
        notes.print("video is written as MPEG-4, which browsers do not play: pip install 'psiamfcpp[video]' for H.264")


def parse_box(text: str) -> Box:
    """A box given as ``x,y,w,h``.

    Raises:
        UserError: not four numbers.
    """
    try:
        x, y, w, h = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"box {text!r} is not x,y,w,h: four numbers, separated by commas") from None
    return (x, y, w, h)
