"""Image files: which they are, in what order, and how they are read."""

from __future__ import annotations

import io
import os
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.errors import UserError
from psiamfcpp.files import is_file, read_bytes
from psiamfcpp.geometry import Image

# In percent: what is darker or brighter is cut off.
_OUTLIERS = (0.1, 99.9)
# How JPEG and PNG begin and end.
_PNG = b"\x89PNG\r\n\x1a\n"
_WHOLE = ((b"\xff\xd8", b"\xff\xd9"), (_PNG, b"IEND\xaeB`\x82"))
IMAGE_SUFFIXES = {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}


class ImageReader:
    """Reads the images of one sequence.

    Images of more than 8 bits, as thermal cameras write them, use a small part of their range, and another one each.
    They are stretched by the range of the first one that has any contrast, so that all have the same grey levels.
    """

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None

    def read(self, path: Path) -> Image:
        """Return an image file as ``(height, width, 3)`` uint8, BGR.

        Raises:
            UserError: the file is missing, is no file or cannot be decoded.
        """
        # imread cannot open every name on every system
        data = np.frombuffer(read_bytes(path, "image", "replace or remove it"), np.uint8)
        try:
            image = _decoded(data)
        except cv2.error:
            image = None
        if image is None:
            raise UserError(f"image {path} cannot be read: replace or remove it")
        return np.asarray(image, np.uint8) if image.dtype == np.uint8 else self.stretched(image)

    def stretched(self, image: NDArray[Any]) -> Image:
        """Return an image ``(H, W, 3)`` of any depth in 8 bits, by the range of the first one."""
        values = image.astype(np.float64)
        finite = values[np.isfinite(values)]
        if self._range is None and finite.size and finite.min() < finite.max():
            # single hot or dead pixels are not the range
            low, high = np.percentile(finite, _OUTLIERS)
            self._range = (low, high) if low < high else (finite.min(), finite.max())
        if self._range is None:
            return np.zeros(image.shape, np.uint8)
        low, high = self._range
        return np.clip(np.nan_to_num((values - low) * (255 / (high - low))).round(), 0, 255).astype(np.uint8)


def read_image(path: Path) -> Image:
    """Return one image file as ``(height, width, 3)`` uint8, BGR; see `ImageReader` for those of a sequence.

    Raises:
        UserError: the file is missing, is no file or cannot be decoded.
    """
    return ImageReader().read(path)


def is_readable(path: Path) -> bool:
    """Whether an image file can be read; most are only looked at, not decoded, since sets hold millions of them."""
    try:
        with path.open("rb") if is_file(path) else io.BytesIO() as file:
            head = file.read(8)
            file.seek(-min(len(head), 8), os.SEEK_END)
            tail = file.read()
    except OSError:
        return False
    if any(head.startswith(begin) and tail.endswith(end) for begin, end in _WHOLE):
        return True
    try:
        return bool(len(read_image(path)))
    except UserError:
        return False


def _decoded(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """The image in three channels and its own depth; None where it is none."""
    if not data.size or _is_damaged_png(data.tobytes() if data[0] == _PNG[0] else b""):
        return None
    quiet_opencv()
    image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:
        # TIFF of real numbers is only read as it is
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        return None
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]


def _is_damaged_png(data: bytes) -> bool:
    """Whether a PNG is cut, or a part of it is not as its checksum says; the decoder would print that itself."""
    if not data.startswith(_PNG):
        return False
    at, kind, kinds = len(_PNG), b"", set[bytes]()
    while kind != b"IEND":
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 8 + size
        stored = data[end : end + 4]
        kinds.add(kind)
        # of parts that may be left out, whose names begin with a small letter, the decoder only warns
        if len(stored) < 4 or (kind[:1].isupper() and zlib.crc32(data[at + 4 : end]) != int.from_bytes(stored, "big")):
            return True
        at = end + 4
    return not kinds >= {b"IHDR", b"IDAT"}


def quiet_opencv() -> None:
    """Keep OpenCV from printing what we say better."""
    # OpenCV 5 moved it; 0 is "silent" in both places
    set_log_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_log_level(0)


def image_files(paths: Iterable[Path]) -> list[Path]:
    """The images among the paths, in natural order: ``2.jpg`` before ``10.jpg``."""
    # what a system leaves behind beside images ("._1.jpg") bears their suffix too
    return sorted((p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "."), key=_natural_order)


def _natural_order(path: Path) -> list[int | str]:
    # every second part is a number, so that like meets like
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", str(path)))]
