"""Parts of ECO: continuous filters in the Fourier domain, their training and their memory of samples.

Danelljan, Bhat, Khan, Felsberg, "ECO: Efficient convolution operators for tracking", CVPR 2017; the interpolation and
the regulariser are those of Danelljan et al., "Beyond correlation filters", ECCV 2016.

A feature block has its own odd grid ``N``. Its spectra are half planes ``(C, N, N // 2 + 1)``: rows are the
frequencies ``-N // 2 … N // 2``, columns ``0 … N // 2``. A *bundle* is a list with one array for each block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import FloatArray
from psiamfcpp.trackers.dcf import fourier

Array = NDArray[Any]
Bundle = list[Array]


def centred(maps: Array) -> Array:
    """Half spectra of real maps ``(…, n, n)`` on the odd grid, lowest frequency in the middle row."""
    rows = maps.shape[-2]
    half = np.roll(fourier.rfft2(maps), (rows - 1) // 2 if rows % 2 else rows // 2, axis=-2)
    # An even grid holds its highest frequency once, an odd one at both ends.
    return half if rows % 2 else np.concatenate([half, half[..., :1, :]], axis=-2)


def frequencies(n: int) -> tuple[FloatArray, FloatArray]:
    """Frequencies of rows and columns of a block on the odd grid ``n``."""
    reach = n // 2
    return np.arange(-reach, reach + 1.0), np.arange(reach + 1.0)


def cubic_kernel(f: FloatArray, a: float) -> FloatArray:
    """Fourier transform of the cubic convolution kernel with parameter ``a``, at ``f`` cycles per sample."""
    w = 2 * np.pi * np.where(f == 0, 1.0, f)
    value = 12 * a + 24 - 24 * np.cos(w) - 12 * a * np.cos(2 * w)
    value -= w * ((12 + 16 * a) * np.sin(w) + 4 * a * np.sin(2 * w))
    return np.where(f == 0, 1.0, value / w**4)


def interpolation(n: int, a: float) -> Array:
    """Factor ``(n, n // 2 + 1)`` that makes a continuous function of samples on a grid of ``n`` cells' centres."""
    rows, columns = (cubic_kernel(k / n, a) / n * np.exp(-1j * np.pi * k / n) for k in frequencies(n))
    return np.outer(rows, columns).astype(np.complex64)


def label(n: int, sigma: float) -> Array:
    """Half spectrum of a periodic Gaussian label of width ``sigma``, in periods (Poisson's formula)."""
    rows, columns = (np.sqrt(2 * np.pi) * sigma * np.exp(-2 * (np.pi * sigma * k) ** 2) for k in frequencies(n))
    return np.outer(rows, columns).astype(np.float32)


def shift(n: int, by: FloatArray) -> Array:
    """Factor that moves the content of a sample by ``-by``, in radians of its period (rows, columns)."""
    rows, columns = (np.exp(1j * k * b) for k, b in zip(frequencies(n), by, strict=True))
    return np.outer(rows, columns).astype(np.complex64)


def inner(a: Array, b: Array) -> float:
    """Real inner product of two half planes ``(…, N, N // 2 + 1)`` as that of the full planes."""
    x, y = a.view(np.float32), b.view(np.float32)  # columns 2k and 2k + 1 are the parts of column k
    return 2 * float(np.vdot(x, y)) - float(np.vdot(x[..., :2], y[..., :2]))


def merge(parts: Sequence[Array], n: int) -> Array:
    """Sum of half planes ``(…, N, N // 2 + 1)`` of several blocks on the largest grid ``n``."""
    total = np.zeros((*parts[0].shape[:-2], n, n // 2 + 1), np.complex64)
    for part in parts:
        middle(total, part.shape[-2])[...] += part
    return total


def middle(plane: Array, n: int) -> Array:
    """The lowest frequencies of a half plane, of a block on the grid ``n``, as a view."""
    edge = (plane.shape[-2] - n) // 2
    return plane[..., edge : edge + n, : n // 2 + 1]


def complete(half: Array) -> Array:
    """Full plane, frequency 0 first, of one half plane ``(N, N // 2 + 1)``."""
    n = half.shape[0]
    return fourier.full_plane(np.roll(half, -(n // 2), axis=0), n)


class Regulariser:
    """Convolution of a filter's spectrum with that of a quadratic window, twice: the penalty ``|w f|²`` (section 3.1).

    The window is a sum of a function of the row and one of the column. So its spectrum is a cross, and convolution
    with it two products by band matrices.

    Args:
        side: of the search window in pixels.
        base: rows and columns of the target in the window.
        edge: height of the window at the target's border.
        least: height in its middle.
        sparsity: coefficients below this share of the largest are dropped.
    """

    def __init__(self, side: int, base: FloatArray, edge: float, least: float, sparsity: float):
        at = np.arange(side) - (side - 1) / 2
        lines = [np.fft.fft((edge - least) * (at / (b / 2)) ** 2) / side for b in base]
        constant = float(sum(line[0].real for line in lines)) + least
        largest = max(constant, *(np.abs(line[1:]).max() for line in lines))
        for line in lines:
            line[np.abs(line) < sparsity * largest] = 0
            line[0] = 0
        # Dropped coefficients move the minimum; the constant brings it back.
        constant = least - float(sum(np.fft.ifft(line).real.min() * side for line in lines))
        down, along = (_taps(line.real) for line in lines)
        down[len(down) // 2] = constant
        self._down, self._along = down, along
        self.energy = float((down**2).sum() + (along**2).sum())

    def operator(self, n: int) -> Callable[[Array], Array]:
        """The double convolution of half planes ``(C, n, n // 2 + 1)``; beyond the grid the spectrum is zero."""
        down, along = self._down, self._along
        rows = [_band(taps, n).astype(np.float32) for taps in (np.convolve(down, down), 2 * down)]
        # Columns of negative frequency are the conjugates of the positive ones, turned by 180 degrees.
        reach = n // 2
        columns = [_band(taps, n)[:, reach:].astype(np.complex64) for taps in (along, np.convolve(along, along))]

        def along_rows(f: Array, band: Array) -> Array:
            return f @ band[reach:] + f[..., ::-1, :0:-1].conj() @ band[:reach]

        def apply(f: Array) -> Array:
            twice, once = (np.matmul(m, f.view(np.float32)).view(np.complex64) for m in rows)
            return twice + along_rows(once, columns[0]) + along_rows(f, columns[1])

        return apply


def _taps(line: FloatArray) -> FloatArray:
    """The non-zero coefficients of a line, lowest frequency in the middle."""
    reach = int(np.flatnonzero(line[: len(line) // 2]).max(initial=0))
    return np.roll(line, reach)[: 2 * reach + 1].copy()


def _band(taps: FloatArray, n: int) -> FloatArray:
    """Matrix ``(n, n)`` of the convolution with symmetric taps."""
    reach = len(taps) // 2
    return sum((np.eye(n, k=k) * taps[reach + k] for k in range(-reach, reach + 1)), np.zeros((n, n)))


@dataclass
class SampleSpace:
    """Weighted samples; when full, similar ones are merged (section 3.3).

    Attributes:
        size: largest number of samples.
        rate: weight of a new sample.
        blocks: for each block ``(size, C, N, N // 2 + 1)``.
        weights: ``(size,)``, sum 1.
    """

    size: int
    rate: float
    blocks: Bundle = field(default_factory=list)
    weights: FloatArray = field(init=False)
    count: int = 0

    def __post_init__(self) -> None:
        self.weights = np.zeros(self.size)
        self._gram = np.full((self.size, self.size), np.inf)

    def samples(self) -> tuple[Bundle, FloatArray]:
        """The samples held, one array ``(count, C, N, N // 2 + 1)`` for each block, and their weights."""
        return [block[: self.count] for block in self.blocks], self.weights[: self.count]

    def put(self, place: int, sample: Bundle) -> None:
        """Store a sample at a place; its weight is left as it is."""
        products = self._products(sample)
        for block, part in zip(self.blocks, sample, strict=True):
            block[place] = part
        products[place] = self._product(sample)
        self._gram[place, : self.count] = self._gram[: self.count, place] = products[: self.count]

    def add(self, sample: Bundle) -> None:
        """Take in a new sample."""
        if not self.blocks:
            self.blocks = [np.zeros((self.size, *part.shape), part.dtype) for part in sample]
        if self.count < self.size:
            self.weights *= 1 - self.rate
            self.weights[self.count] = self.rate if self.count else 1.0
            self.count += 1
            self.put(self.count - 1, sample)
            return
        least = int(np.argmin(self.weights))
        if self.weights[least] < self.rate * (1 - self.rate) ** (2 * self.size):
            self.weights[least] = 0
            self.weights *= (1 - self.rate) / self.weights.sum()
            self.weights[least] = self.rate
            self.put(least, sample)
            return
        norms = np.diag(self._gram)
        apart = np.maximum(norms + self._product(sample) - 2 * self._products(sample), 0)
        between = np.maximum(norms[:, None] + norms - 2 * self._gram, 0)
        np.fill_diagonal(between, np.inf)
        self.weights *= 1 - self.rate
        nearest = int(np.argmin(apart))
        if apart[nearest] < between.min():
            old = self.weights[nearest]
            self._blend(nearest, [block[nearest] for block in self.blocks], old, sample, self.rate)
            self.weights[nearest] = old + self.rate
            return
        first, second = np.unravel_index(np.argmin(between), between.shape)
        kept, freed = (first, second) if self.weights[first] >= self.weights[second] else (second, first)
        one, other = ([block[i] for block in self.blocks] for i in (kept, freed))
        self._blend(int(kept), one, self.weights[kept], other, self.weights[freed])
        self.weights[kept] += self.weights[freed]
        self.weights[freed] = self.rate
        self.put(int(freed), sample)

    def _blend(self, place: int, a: Bundle, weight_a: float, b: Bundle, weight_b: float) -> None:
        share = np.float32(weight_a / (weight_a + weight_b))
        self.put(place, [x * share + y * (1 - share) for x, y in zip(a, b, strict=True)])

    def _products(self, sample: Bundle) -> FloatArray:
        """Products of all places with a sample. As in the authors' code over the half plane, every column twice."""
        total = np.zeros(self.size)
        for block, part in zip(self.blocks, sample, strict=True):
            total += 2 * (block.reshape(self.size, -1).view(np.float32) @ part.reshape(-1).view(np.float32))
        return total

    @staticmethod
    def _product(sample: Bundle) -> float:
        return sum(2 * float(np.vdot(part, part).real) for part in sample)


@dataclass
class Momentum:
    """What conjugate gradients keep from one training to the next."""

    direction: Bundle
    residual: Bundle
    """before the last step"""
    rho: float


def conjugate_gradients(
    operator: Callable[[Bundle], Bundle],
    right: Bundle,
    precondition: Callable[[Bundle], Bundle],
    product: Callable[[Bundle, Bundle], float],
    start: Bundle,
    iterations: int,
    momentum: Momentum | None = None,
    fletcher_reeves: bool = False,
) -> tuple[Bundle, Momentum | None]:
    """Solve ``operator(x) = right`` approximately by preconditioned conjugate gradients.

    Args:
        operator: linear, symmetric and positive.
        right: right side.
        precondition: approximate inverse of the operator.
        product: inner product.
        start: where to start; not changed.
        iterations: number of steps.
        momentum: of the last call, if it goes on.
        fletcher_reeves: the formula of the direction; Polak and Ribière's otherwise.

    Returns:
        The solution, and the momentum to go on with.
    """
    x = [part.copy() for part in start]
    r = [b - a for b, a in zip(right, operator(x), strict=True)]
    for step in range(iterations):
        z = precondition(r)
        rho = product(r, z)
        if not np.isfinite(rho) or rho <= 0:
            break
        if momentum is None:
            p = z
        else:
            correlation = 0.0 if fletcher_reeves else product(momentum.residual, z)
            beta = np.float32(max(0.0, (rho - correlation) / momentum.rho))
            p = [a + beta * b for a, b in zip(z, momentum.direction, strict=True)]
        q = operator(p)
        curvature = product(p, q)
        momentum = Momentum(p, r, rho)
        if not np.isfinite(curvature) or curvature <= 0:
            break
        alpha = np.float32(rho / curvature)
        x = [a + alpha * b for a, b in zip(x, p, strict=True)]
        if step + 1 < iterations:
            r = [a - alpha * b for a, b in zip(r, q, strict=True)]
    return x, momentum
