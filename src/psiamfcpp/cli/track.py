"""`psiamfcpp track`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import tyro

from psiamfcpp.cli.arguments import Overwrite, SourceName
from psiamfcpp.cli.output import check_new, notes, parse_box, print_json, progress, say_of_video
from psiamfcpp.cli.targets import check_way, find_targets, write_frame
from psiamfcpp.errors import UserError
from psiamfcpp.files import check_outputs
from psiamfcpp.geometry import Image
from psiamfcpp.recipes.follow import Outputs, follow_to_files
from psiamfcpp.trackers import STATES, State, TargetPool, Track, TrackerOptions
from psiamfcpp.version import __version__
from psiamfcpp.video.boxes import boxes_paths
from psiamfcpp.video.drawing import Overlay
from psiamfcpp.video.source import Source, open_source
from psiamfcpp.video.span import Shot, Span, shots
from psiamfcpp.video.streams import has_sound
from psiamfcpp.video.threads import ahead
from psiamfcpp.zoo import DEFAULT_MODEL


def track(
    source: SourceName,
    box: tyro.conf.UseAppendAction[list[str]],
    select: bool = False,
    frame: Path | None = None,
    model: str = DEFAULT_MODEL,
    tracker: str | None = None,
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    boxes: Path | None = None,
    span: Span = Span(),  # noqa: B008 - frozen
    overlay: Overlay = Overlay(),  # noqa: B008 - frozen
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
    overwrite: Overwrite = False,
    json: bool = False,
) -> None:
    """Follow a target through a video.

    Args:
        source: video file, camera number, address (rtsp://, http://, udp://, srt://, rtmp://, tcp://), session (.sdp),
            GStreamer pipeline, folder of images, or glob of images.
        box: x,y,w,h of the target on the first frame that is followed, pixels, 0-based; repeat it to follow several.
            Without it, a page opens on which targets and the first frame are chosen.
        select: draw the box in a window of OpenCV instead, where it has windows.
        frame: write the first frame with a grid of coordinates to this .png or .jpg, and end.
        model: name of a shipped model, or a model file.
        tracker: any other tracker instead, as opencv:mil, dcf:kcf or module:pkg.mod:Class.
        output: video to write (.mp4, .mov, .mkv or .avi) with box, score, state and speed.
        boxes: file to write. .csv and .jsonl: seconds, frame, target, box, score and state of each target and frame.
            Text otherwise: one x,y,w,h per line; with several targets one each, NAME.1.txt, NAME.2.txt...
        span: which part of the source.
        overlay: what is drawn.
        options: how the model runs.
        json: print one JSON object: source, tracker, frame numbers, boxes; with several targets, also all in targets.
    """
    starts = [parse_box(text) for text in box]

    def check(*paths: Path | None) -> None:
        check_outputs(paths, [source, model, tracker])
        check_new(paths, overwrite)

    if frame is not None:
        check(frame)
        with open_source(source, on_event=notes.print) as video:
            print(write_frame(frame, video, span, starts))
        return
    if not starts:
        check_way(json, select)
    check(output, *([] if boxes is None else boxes_paths(boxes, len(starts) or 1)))
    with contextlib.ExitStack() as files:
        video = files.enter_context(open_source(source, on_event=notes.print))
        if output is not None:
            say_of_video()
            if has_sound(source):
                notes.print(f"the sound of {source} is left out of {output}")
        pool = TargetPool(tracker or model, options=options)
        files.callback(pool.close)
        images: Iterable[Image] = video
        if not starts:
            starts, span, images = find_targets(video, span, select)
            check(output, *([] if boxes is None else boxes_paths(boxes, len(starts))))
        bar = files.enter_context(progress())
        task = bar.add_task(video.name, total=video.frame_count)
        outputs = Outputs(output, boxes, overlay)
        frames = files.enter_context(_read(video, images, span, lambda: bar.advance(task)))
        result = follow_to_files(frames, pool, starts, video.fps, outputs, span.every)
    # by target instead of by frame
    targets = [list(tracks) for tracks in zip(*result.tracks, strict=True)]
    count = len(result.tracks)
    if json:
        figures = [_columns(tracks) for tracks in targets]
        about = _about(video, result.size, tracker or model)
        found = {"frames": count, "fps": result.fps, "numbers": result.numbers, **figures[0]}
        print_json({**about, **found, **({"targets": figures} if figures[1:] else {})})
    else:
        numbers = [f"target {number} " if targets[1:] else "" for number in range(1, len(targets) + 1)]
        summaries = [
            number + _summary([t.state for t in tracks]) for number, tracks in zip(numbers, targets, strict=True)
        ]
        print(f"{count} frames at {result.fps:.1f} fps; {'; '.join(summaries)}")
    if result.ended == "interrupted":
        raise KeyboardInterrupt
    if result.ended:
        raise UserError(f"{result.ended} (the {count} frames before that were followed)")


@contextlib.contextmanager
def _read(video: Source, images: Iterable[Image], span: Span, advance: Callable[[], None]) -> Iterator[Iterator[Shot]]:
    """Give the frames of a span; they are read ahead in a thread, but not those of a live source, which grow old."""

    def counted() -> Iterator[Image]:
        for frame in images:
            advance()
            yield frame

    selected = shots(counted(), video.fps, span)
    with contextlib.nullcontext(selected) if video.live else ahead(selected) as read:
        yield read


def _about(video: Source, size: tuple[int, int], tracker: str) -> dict[str, Any]:
    width, height = size
    source = {"name": video.name, "width": width, "height": height, "fps": video.fps}
    return {"version": __version__, "tracker": tracker, "source": source}


def _columns(tracks: list[Track]) -> dict[str, list[Any]]:
    return {
        "boxes": [t.box for t in tracks],
        "scores": [t.score for t in tracks],
        "states": [t.state for t in tracks],
    }


def _summary(states: list[State | None]) -> str:
    counts = {state: states.count(state) for state in STATES}
    named = ", ".join(f"{state} in {count}" for state, count in counts.items() if count)
    return named or "followed; this tracker states no confidence of its own"
