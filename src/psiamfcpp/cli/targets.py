"""Where the boxes of `psiamfcpp track` come from when none is given."""

from __future__ import annotations

import dataclasses
import importlib.util
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2

from psiamfcpp.cli.output import notes
from psiamfcpp.errors import UserError
from psiamfcpp.files import write_whole
from psiamfcpp.geometry import Box, Image
from psiamfcpp.video.drawing import draw, target_colour
from psiamfcpp.video.grid import draw_grid
from psiamfcpp.video.source import Source
from psiamfcpp.video.span import Span, frame_number, shots


def check_way(json: bool, select: bool) -> None:
    """Refuse at once what can give no box.

    Args:
        json: a program reads the output, so nobody is asked.
        select: a window was asked for.

    Raises:
        UserError: names the ways to give a box.
    """
    if select:
        return
    ways = "draw it on the page that opens without --box in a terminal, or read it from the grid of --frame FILE.png"
    missing = f"--box is missing: give x,y,w,h of the target in pixels; {ways}"
    if json or not sys.stderr.isatty():
        raise UserError(missing)
    if any(importlib.util.find_spec(name) is None for name in ("fastapi", "uvicorn", "websockets")):
        raise UserError(f"{missing} (the page needs: pip install 'psiamfcpp[serve]')")


def find_targets(video: Source, span: Span, select: bool) -> tuple[list[Box], Span, Iterable[Image]]:
    """Have the user choose, in a window of OpenCV or on a page.

    Args:
        video: opened, nothing read from it yet.
        span: begins where the choice is offered.
        select: in a window, on the first frame of the span.

    Returns:
        The boxes, the span from the frame that they were drawn on, and the frames of the source.

    Raises:
        UserError: there is no window, nothing was chosen, or the source cannot be read.
    """
    if select:
        number, image = next(shots(video, video.fps, dataclasses.replace(span, stop=None)))
        boxes, frames = [_select(image)], _again(video, image)
    else:
        from psiamfcpp.serve.choose import choose

        chosen = choose(video, 0 if video.live else frame_number(span.start, video.fps))
        number, boxes = chosen.start_frame, chosen.boxes
        frames = chosen.frames if video.live else _again(video)
    start = "0" if video.live else f"#{number}"
    if not video.live:
        notes.print(f"next time: {command_again(video.name, boxes, start)}", markup=False)
    return boxes, dataclasses.replace(span, start=start), frames


def command_again(source: str, boxes: Sequence[Box], start: str) -> str:
    """The command line that follows the same boxes without asking."""
    given = sys.argv[2:] if sys.argv[1:2] == ["track"] and source in sys.argv else [source]
    kept: list[str] = []
    for at, arg in enumerate(given):
        after_start = at > 0 and given[at - 1] == "--start"
        if arg not in ("--select", "--start") and not arg.startswith("--start=") and not after_start:
            kept.append(arg)
    found = [part for box in boxes for part in ("--box", ",".join(f"{v:g}" for v in box))]
    return shlex.join(["psiamfcpp", "track", *kept, *found, "--start", start])


def write_frame(path: Path, video: Source, span: Span, boxes: Sequence[Box]) -> str:
    """Write the first frame of a span with a grid of coordinates; what was written, in a line.

    Args:
        path: PNG or JPEG file.
        video: opened, nothing read from it yet.
        span: its start names the frame.
        boxes: drawn too, as a check.

    Raises:
        UserError: the frame cannot be read, or the file not written.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise UserError(f"frame {path} has an unknown format: name it .png or .jpg")
    number, frame = next(shots(video, video.fps, dataclasses.replace(span, stop=None)))
    image = draw_grid(frame)
    for at, box in enumerate(boxes, start=1):
        image = draw(image, box, str(at), target_colour(at))
    ok, data = cv2.imencode(path.suffix.lower(), image)
    if not ok:
        raise UserError(f"frame {path} cannot be written: OpenCV refuses this format")
    write_whole(path, data.tobytes())
    height, width = frame.shape[:2]
    return f"frame {number} of {video.name}, {width}x{height}, with coordinates: {path}"


def _select(image: Image) -> Box:
    title = "draw a box, Enter takes it, c cancels"
    try:
        cv2.namedWindow(title)  # fails where there are none, before anything is printed
        x, y, w, h = (float(v) for v in cv2.selectROI(title, image, showCrosshair=False))
        cv2.destroyWindow(title)
    except cv2.error:
        instead = "leave it out to draw on a page, or use --frame FILE.png"
        raise UserError(f"--select needs an OpenCV with windows, and a screen: {instead}") from None
    if not (w and h):
        raise UserError("no box was drawn: start again, or give --box x,y,w,h")
    return (x, y, w, h)


def _again(video: Source, first: Image | None = None) -> Iterable[Image]:
    """The frames of a source from its start; of a live one from the frame that was shown."""
    if video.live and first is not None:
        return _chained(first, video)
    video.seek(0)
    return video


def _chained(first: Image, video: Source) -> Iterable[Image]:
    yield first
    yield from video
