"""`psiamfcpp demo`."""

from __future__ import annotations

import contextlib
import itertools
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from psiamfcpp.cli.arguments import Json, Output, Overwrite
from psiamfcpp.cli.output import check_new, print_json, progress, say_of_video
from psiamfcpp.demo.clip import DemoFrame, render
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.metrics import score_sequence
from psiamfcpp.geometry import Image
from psiamfcpp.recipes.follow import Outputs, follow_to_files
from psiamfcpp.trackers import TargetPool, TrackerOptions
from psiamfcpp.video.span import Shot
from psiamfcpp.video.writer import VideoWriter
from psiamfcpp.zoo import DEFAULT_MODEL

FPS = 30.0
DEFAULT_OUTPUT = Path("demo.mp4")
"""replaced unasked, so that the command can be given again"""


def demo(
    output: Output = DEFAULT_OUTPUT,
    model: str = DEFAULT_MODEL,
    frames: int = 300,
    seed: int = 4,
    tracker: str | None = None,
    options: TrackerOptions = TrackerOptions(),  # noqa: B008 - frozen
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Render an aerial clip, follow its target, write the video and print how well it went.

    The clip itself is written beside the video, as NAME-clip, and the command that follows its target is printed.

    Args:
        output: video to write, with box, state and score; demo.mp4 is replaced without asking.
        model: name of a shipped model, or a model file.
        frames: length of the clip.
        seed: seed of land, traffic and camera.
        tracker: any other tracker instead, as opencv:mil or dcf:kcf.
        options: how the model runs.
    """
    clean = output.with_name(f"{output.stem}-clip{output.suffix}")
    check_new([output, clean], overwrite or output == DEFAULT_OUTPUT)
    if frames < 2:
        raise UserError(f"frames is {frames}: a clip needs at least 2")
    pool = TargetPool(tracker or model, options=options)
    say_of_video()
    shots = render(seed, frames)
    first = next(shots)
    clip: list[DemoFrame] = []

    def images(files: contextlib.ExitStack) -> Iterator[Image]:
        writer: VideoWriter | None = None
        for shot in itertools.chain([first], shots):
            # Labels are kept and images dropped, so that memory does not grow with the clip.
            clip.append(DemoFrame(shot.image[:0], shot.box, shot.visible))
            yield shot.image
            # Only now, when the annotated video is open: a wrong --output must leave nothing.
            size = (shot.image.shape[1], shot.image.shape[0])
            writer = writer or files.enter_context(VideoWriter(clean, FPS, size))
            writer.write(shot.image)

    with progress() as bar, contextlib.ExitStack() as files:
        task = bar.add_task("demo", total=frames)
        result = follow_to_files(
            itertools.starmap(Shot, enumerate(images(files))),
            pool,
            [first.box],
            FPS,
            Outputs(output),
            advance=lambda: bar.advance(task),
        )
    if result.ended:
        raise KeyboardInterrupt
    truth = np.array([shot.box for shot in clip])
    visible = np.array([shot.visible for shot in clip])
    # Where the target is hidden there is nothing to see, so nothing is asked: such frames are left out.
    found = np.array([track.box for (track,) in result.tracks])
    figures = score_sequence(truth[visible], found[visible]).figures
    states = [track.state for (track,), seen in zip(result.tracks, visible, strict=True) if not seen]
    # of a tracker that states nothing, nothing is counted
    doubted = None if None in states else sum(state != "tracking" for state in states)
    hidden = {"hidden_frames": len(states), "hidden_not_tracking": doubted}
    if json:
        files_written = {"output": str(output), "clip": str(clean), "box": list(first.box)}
        print_json({"frames": len(clip), "fps": result.fps, **figures, **hidden, **files_written})
        return
    print(f"precision {figures['precision']:.3f}, AUC {figures['auc']:.3f} over {int(visible.sum())} visible frames")
    said = "; this tracker states no confidence" if doubted is None else f", in {doubted} of them unsure or lost"
    print(f"hidden for {len(states)} frames{said}")
    print(f"{result.fps:.1f} fps; video in {output}")
    box = ",".join(f"{value:.0f}" for value in first.box)
    print("the same on the clip without drawings:")
    print(f"psiamfcpp track {shlex.quote(str(clean))} --box {box} --output followed.mp4")
