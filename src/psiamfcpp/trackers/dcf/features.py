"""What the filters see of a patch: fHOG, grey cells, colour names; and the colour histograms of Staple and MCCT.

Patches are uint8, BGR (fHOG and grey also of one channel). Features are float32, channels first,
``(channels, h // cell, w // cell)``; rows and columns that fill no cell are left out.
"""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from psiamfcpp.trackers.dcf import kernels
from psiamfcpp.trackers.dcf.geometry import Pixels, Size

Float = NDArray[np.float32]

HOG_CHANNELS = 31
NAME_CHANNELS = 10
# Weights of MATLAB's rgb2gray, in the order B, G, R.
_GREY = np.array([[0.114021, 0.587043, 0.298936]])
_NAMES = Path(__file__).with_name("colour_names.npz")


def _cells(patch: Pixels, cell: int) -> Size:
    return patch.shape[0] // cell, patch.shape[1] // cell


def fhog(patch: Pixels, cell: int = 4, out: Float | None = None, sse: bool = False) -> Float:
    """Histograms of gradient orientations (Felzenszwalb et al. 2010, section 6), 31 channels.

    18 signed orientations, 9 unsigned ones, 4 texture channels. Values: 0-255, but 0-1 for KCF; they differ in flat
    regions only.

    Args:
        patch: ``(h, w)`` or ``(h, w, C)``, uint8 or float32.
        cell: side of a cell in pixels.
        out: array ``(31, h // cell, w // cell)`` to write into.
        sse: take the approximate square roots of the processor that the authors' boxes were made on, see `kernels`. All
            filters do: they decide between near-equal scales.
    """
    if out is None:
        out = np.empty((HOG_CHANNELS, *_cells(patch, cell)), np.float32)
    fhog_many(patch[None], cell, out[None], sse)
    return out


def fhog_many(patches: Pixels, cell: int = 4, out: Float | None = None, sse: bool = False) -> Float:
    """`fhog` of patches ``(n, h, w)`` or ``(n, h, w, C)`` of one size, as ``(n, 31, h // cell, w // cell)``."""
    if patches.ndim == 3:
        patches = patches[..., None]
    if out is None:
        out = np.empty((len(patches), HOG_CHANNELS, *_cells(patches[0], cell)), np.float32)
    if out.size:
        kernels.fhog(np.ascontiguousarray(patches), kernels.ORIENTATION_BINS, kernels.ROOTS, sse, cell, out)
    return out


def grey(patch: Pixels) -> Pixels:
    """Grey patch ``(h, w)`` uint8, as MATLAB's rgb2gray of uint8."""
    return patch if patch.ndim == 2 else cv2.transform(patch, _GREY)


def cell_means(plane: Pixels, cell: int) -> Float:
    """Means ``(h // cell, w // cell)`` of a plane ``(h, w)`` over its cells."""
    rows, columns = _cells(plane, cell)
    cut = plane[: rows * cell, : columns * cell].astype(np.float32)
    # for a whole ratio the area rule is the plain mean
    return np.asarray(cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def grey_cells(patch: Pixels, cell: int = 4) -> Float:
    """Mean grey of each cell, ``grey / 255 - 0.5`` of unrounded grey (STRCF, ARCF, AutoTrack), ``(h', w')``."""
    # the mean of the colours first: both are linear
    rows, columns = _cells(patch, cell)
    cut = patch[: rows * cell, : columns * cell].astype(np.float32)
    means = cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA)
    plane = means if means.ndim == 2 else cv2.transform(means, _GREY.astype(np.float32))
    return plane / np.float32(255) - np.float32(0.5)


@functools.cache
def colour_name_table() -> Float:
    """The ten colour names of each of 32,768 colours, ``(32768, 10)``.

    Van de Weijer, Schmid, Verbeek, Larlus, "Learning color names for real-world applications", TIP 2009, projected
    by Danelljan et al., CVPR 2014; origin of the numbers and notice: ``colour_names.txt`` beside this file.
    """
    with np.load(_NAMES) as file:
        return file["table"].astype(np.float32) / np.float32(32767)


def colour_names(patch: Pixels, cell: int = 4, out: Float | None = None) -> Float:
    """Colour names, averaged in cells, 10 channels (Danelljan et al., CVPR 2014).

    Args:
        patch: ``(h, w, 3)`` uint8, BGR.
        cell: side of a cell in pixels; 1 looks up each pixel.
        out: array ``(10, h // cell, w // cell)`` to write into.
    """
    if out is None:
        out = np.empty((NAME_CHANNELS, *_cells(patch, cell)), np.float32)
    kernels.table_cells(patch, colour_name_table(), cell, out)
    return out


def grey_hog_names(patch: Pixels, cell: int = 4, colour: bool = True) -> Float:
    """Grey cells, fHOG and colour names in one array of 42 channels, without colour 32 (STRCF, ARCF, AutoTrack)."""
    count = 1 + HOG_CHANNELS + (NAME_CHANNELS if colour else 0)
    out = np.empty((count, *_cells(patch, cell)), np.float32)
    out[0] = grey_cells(patch, cell)
    fhog(patch, cell, out[1 : 1 + HOG_CHANNELS], sse=True)
    if colour:
        colour_names(patch, cell, out[1 + HOG_CHANNELS :])
    return out


def normalise_energy(block: Float) -> Float:
    """A feature block ``(..., c, h, w)`` times ``sqrt(h w c / sum of squares)`` (ECO), per sample."""
    count = np.prod(block.shape[-3:])
    energy = np.sum(np.square(block, dtype=np.float32), axis=(-3, -2, -1), keepdims=True)
    return block * np.sqrt(np.float32(count) / (energy + np.float32(2.2e-16)))
