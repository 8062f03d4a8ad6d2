"""Image files: which they are, in what order, and how they are read."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image

IMAGE_SUFFIXES = {".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"}


def read_image(path: Path) -> Image:
    """An image file as ``(height, width, 3)`` uint8, BGR.

    Raises:
        UserError: the file is missing or cannot be decoded.
    """
    try:
        # imread cannot open every name on every system
        data = np.fromfile(path, dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except FileNotFoundError:
        raise UserError(f"image {path} does not exist") from None
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise UserError(f"image {path} cannot be read: replace or remove it")
    return np.asarray(image, dtype=np.uint8)


def image_files(paths: Iterable[Path]) -> list[Path]:
    """The images among the paths, in natural order: ``2.jpg`` before ``10.jpg``."""
    # what a system leaves behind beside images ("._1.jpg") bears their suffix too
    return sorted((p for p in paths if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "."), key=_natural_order)


def _natural_order(path: Path) -> list[int | str]:
    # every second part is a number, so that like meets like
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", str(path)))]
