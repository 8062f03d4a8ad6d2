"""Labels, windows, transforms of real maps, and the peak of a response between its grid points.

Maps are channels first, ``(..., rows, columns)``. Spectra of real maps are half planes, columns ``0 .. n // 2``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from psiamfcpp.geometry import FloatArray

Real = NDArray[Any]
Spectrum = NDArray[Any]
Size = tuple[int, int]


def rfft2(maps: Real) -> Spectrum:
    """Half spectra ``(..., rows, columns // 2 + 1)`` of real maps, in their precision."""
    return scipy.fft.rfft2(maps, workers=1)


def irfft2(half: Spectrum, size: Size) -> Real:
    """Real maps ``(..., *size)`` of half spectra.

    Of a full plane the first ``columns // 2 + 1`` columns are read, as MATLAB's symmetric inverse does; it matters
    for spectra that are not Hermitian.
    """
    return scipy.fft.irfft2(half[..., : size[1] // 2 + 1], s=size, workers=1)


def fft2(maps: Real) -> Spectrum:
    """Full spectra of real or complex maps, in their precision."""
    return scipy.fft.fft2(maps, workers=1)


def ifft2(spectra: Spectrum) -> Spectrum:
    """Complex maps of full spectra."""
    return scipy.fft.ifft2(spectra, workers=1)


def full_plane(half: Spectrum, columns: int) -> Spectrum:
    """Full spectra ``(..., rows, columns)`` of half spectra of real maps."""
    rest = half[..., 1 : columns - columns // 2]
    # the coefficient at (-y, -x) is the conjugate of that at (y, x)
    mirrored = np.roll(rest[..., ::-1, ::-1], 1, axis=-2).conj()
    return np.concatenate([half, mirrored], axis=-1)


def offsets(n: int) -> FloatArray:
    """Signed distance of each index from index 0 on a ring of ``n``; also the frequencies of a transform."""
    left = (n - 1) // 2
    return np.mod(np.arange(n, dtype=np.float64) + left, n) - left


def label(size: Size, sigma: float, along: Callable[[int], FloatArray] = offsets) -> FloatArray:
    """Gaussian of standard deviation ``sigma`` cells; its peak is where ``along`` is 0 on both axes."""
    rows, columns = (np.exp(-(along(n) ** 2) / (2 * sigma**2)) for n in size)
    return np.outer(rows, columns)


def hann(n: int) -> FloatArray:
    """Symmetric Hann window ``0.5 (1 - cos(2 pi i / (n - 1)))``; 1 for a single cell."""
    return np.asarray(np.hanning(n), np.float64)


def hann2(size: Size, inner: bool = False) -> FloatArray:
    """Hann window on both axes; with ``inner`` without the zeros at its ends, the inner part of ``n + 2``."""
    rows, columns = (hann(n + 2)[1:-1] if inner else hann(n) for n in size)
    return np.outer(rows, columns)


def argmax2(response: Real) -> tuple[int, int]:
    """Row and column of the maximum; of equal ones the first, column by column, as in MATLAB."""
    column, row = np.unravel_index(np.argmax(response.T), response.T.shape)
    return int(row), int(column)


def displacement(index: tuple[int, int], size: Size) -> FloatArray:
    """Signed shift that an index of a response stands for; zero shift is index 0."""
    return np.array([offsets(n)[i] for i, n in zip(index, size, strict=True)])


def newton_peak(spectra: Spectrum, iterations: int) -> tuple[FloatArray, int, float]:
    """The highest peak of several responses, refined by Newton's method on their trigonometric polynomials.

    Args:
        spectra: full planes ``(S, rows, columns)``, one for each scale.
        iterations: largest number of steps; less where all have converged.

    Returns:
        Displacement ``(rows, columns)`` in cells, index of the scale, and the value there.
    """
    scales, *size = spectra.shape
    ny, nx = size
    responses = irfft2(spectra, (ny, nx)).astype(np.float64)
    places = [argmax2(r) for r in responses]
    start = 2 * np.pi * np.array([displacement(p, (ny, nx)) for p in places]) / size
    grid = np.array([r[p] for r, p in zip(responses, places, strict=True)])
    planes = spectra.astype(np.complex128)
    powers = np.arange(3)
    ky, kx = offsets(ny), offsets(nx)

    def moments(at: FloatArray) -> Spectrum:
        # entry (a, b) is the sum of ky^a kx^b F exp(i (ky py + kx px)): value, gradient and Hessian in one product
        ey = np.exp(1j * at[:, :1] * ky)[:, None] * ky ** powers[:, None]
        ex = np.exp(1j * at[:, 1:] * kx)[..., None] * kx[:, None] ** powers
        return ey @ (planes @ ex)

    at = start.copy()
    for _ in range(iterations):
        m = moments(at)
        gy, gx = -m[:, 1, 0].imag, -m[:, 0, 1].imag
        v = -m[:, 0, 0].imag  # real part of i times the value
        hyy, hxx, hxy = v - m[:, 2, 0].real, v - m[:, 0, 2].real, -m[:, 1, 1].real
        determinant = hyy * hxx - hxy * hxy
        usable = np.abs(determinant) > 1e-300
        inverse = np.divide(1.0, determinant, out=np.zeros(scales), where=usable)
        step = np.stack([hxx * gy - hxy * gx, hyy * gx - hxy * gy], axis=1) * inverse[:, None]
        at -= step
        if np.abs(step).max() < 1e-12:
            break
    values = moments(at)[:, 0, 0].real / (ny * nx)
    refined = values >= grid
    at = np.where(refined[:, None], at, start)
    values = np.where(refined, values, grid)
    best = int(np.argmax(values))
    shift = (np.mod(at[best] + np.pi, 2 * np.pi) - np.pi) / (2 * np.pi) * size
    return shift, best, float(values[best])


def irfft2_finer(half: Spectrum, size: Size, factor: int) -> Real:
    """Real maps of half spectra, on a grid finer by a whole factor (fDSST, section 3.3).

    Args:
        half: of maps of ``size``; at even sizes the coefficient at half the sampling rate is dropped, as in the code.
        size: rows and columns of the coarse grid.
        factor: fine cells per coarse cell and axis.
    """
    (rows, columns), front, back = size, (size[0] + 1) // 2, (size[0] - 1) // 2
    wide = np.zeros((*half.shape[:-2], rows * factor, columns * factor // 2 + 1), half.dtype)
    kept = (columns + 1) // 2
    wide[..., :front, :kept] = half[..., :front, :kept]
    if back:
        wide[..., -back:, :kept] = half[..., -back:, :kept]
    return irfft2(wide, (rows * factor, columns * factor)) * half.real.dtype.type(factor**2)


def phase_shift(size: Size, shift: FloatArray) -> Spectrum:
    """Factor ``exp(i (ky a + kx b))`` on a full plane, which moves a map by ``-(a, b)`` radians of its period."""
    rows, columns = (np.exp(1j * offsets(n) * s) for n, s in zip(size, shift, strict=True))
    return np.outer(rows, columns)
