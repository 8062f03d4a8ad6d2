"""Make the moving image of the README from the clip that `psiamfcpp demo` writes.

    psiamfcpp demo
    psiamfcpp track demo-clip.mp4 --box 584,326,68,41 --output followed.mp4 --no-fps
    python docs/make_moving_image.py followed.mp4 -o docs/images/demo.webp

Needs Pillow, which matplotlib installs.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated

import cv2
import tyro
from PIL import Image

from psiamfcpp.errors import UserError
from psiamfcpp.files import write_whole
from psiamfcpp.video.source import open_source

LARGEST = 3_000_000


def main(
    video: tyro.conf.Positional[Path],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    every: int = 3,
    width: int = 560,
    quality: int = 45,
    method: int = 4,
) -> None:
    """Write an animated WebP that repeats for ever.

    Args:
        video: what to show.
        output: the image, .webp.
        every: show one frame in N; the pace stays.
        width: of the image, pixels.
        quality: of the image, 0 to 100.
        method: of compression, 0 (fast) to 6 (small).
    """
    with open_source(video) as source:
        milliseconds = round(1000 * every / source.fps)
        frames = []
        for number, frame in enumerate(source):
            if number % every == 0:
                height = round(frame.shape[0] * width / frame.shape[1])
                small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
                frames.append(Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB)))
    written = io.BytesIO()
    frames[0].save(
        written,
        "WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=milliseconds,
        loop=0,
        quality=quality,
        method=method,
    )
    size = written.tell()
    if size > LARGEST:
        raise UserError(f"{output} would have {size:,} bytes, more than {LARGEST:,}: raise --every or lower --quality")
    write_whole(output, written.getvalue())
    print(f"{output}: {len(frames)} images, {size:,} bytes")


if __name__ == "__main__":
    tyro.cli(main)
