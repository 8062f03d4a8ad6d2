"""The ADMM loop that BACF, STRCF, ARCF-HC and AutoTrack share.

All four train a filter ``f`` so that its response to the sample ``x`` is the label ``y``, while an auxiliary filter,
equal to ``f`` at convergence, is held small outside the target. Their closed forms for ``f`` are one formula: with
``T`` cells, penalty ``γ``, pull ``μ`` towards the previous filter and gain ``m`` of the sample (``m = γ_M M``, which
only ARCF-HC has), at every frequency

    f = (n − x·(xᴴn) / (xᴴx + T·d)) / c,   n = x·(y/T + m) + r,   r = μ·f_prev + γ·aux − mult,
    c = γ + μ,   d = c / (1 + γ_M)

which is the Sherman-Morrison inverse of ``(x xᴴ/(T d) + I) c f = n``. The vectors run over the channels.

Sources: BACF, ICCV 2017, eq. 5 to 9; STRCF, CVPR 2018, eq. 8 to 11; ARCF, ICCV 2019, eq. 8 to 14; AutoTrack, CVPR
2020, eq. 7 to 13; penalties and scalings as in the authors' code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

Spectrum = NDArray[np.complex64]
"""``(C, H, W')``: the spectrum of every channel, with ``W' = W // 2 + 1`` where only a half is kept"""
Map = NDArray[Any]
"""``(H, W)`` in space or ``(H, W')`` in frequency: one value per cell"""


@dataclass(frozen=True, slots=True)
class Transform:
    """A Fourier transform of the last two axes and its inverse."""

    forward: Callable[[Map], Spectrum]
    inverse: Callable[[Spectrum, tuple[int, int]], Map]
    """takes the spectrum and the number of cells ``(H, W)``"""


REAL = Transform(
    forward=lambda a: scipy.fft.rfft2(a, overwrite_x=True),
    inverse=lambda a, cells: scipy.fft.irfft2(a, s=cells, overwrite_x=True),
)
"""half spectra: the filters are real in space"""
COMPLEX = Transform(
    forward=lambda a: scipy.fft.fft2(a, overwrite_x=True),
    inverse=lambda a, cells: scipy.fft.ifft2(a, overwrite_x=True),
)
"""full spectra: for ARCF-HC, whose spectra are not Hermitian"""


@dataclass(frozen=True, slots=True)
class Scheme:
    """What differs between the four trackers in the loop itself.

    Attributes:
        penalties: ``γ`` of every iteration; their number is the number of iterations.
        weights: the auxiliary step in space as a function of ``γ``: the map ``(H, W)`` that multiplies the inverse
            transform of ``γ·f + mult``.
        transform: `REAL` or `COMPLEX`.
        scaled_multiplier: AutoTrack's code multiplies the multiplier by ``γ`` in the auxiliary step, but not in
            the filter step.
    """

    penalties: tuple[float, ...]
    weights: Callable[[float], Map]
    transform: Transform = REAL
    scaled_multiplier: bool = False


@dataclass(frozen=True, slots=True)
class Temporal:
    """The term that keeps a filter near the one before.

    Attributes:
        previous: the filter of the previous frame.
        pull: ``μ`` of an iteration, given the filter of the iteration before (None in the first).
    """

    previous: Spectrum
    pull: Callable[[Spectrum | None], float]


def constrained(mask: NDArray[np.bool_], lam: float) -> Callable[[float], Map]:
    """Weights of the auxiliary step of BACF and ARCF-HC: zero outside ``mask`` ``(H, W)``, ``T / (γT + λ)`` inside."""
    inside = mask.astype(np.float32)
    return lambda penalty: inside * np.float32(mask.size / (penalty * mask.size + lam))


def energy(x: Spectrum) -> Map:
    """Return ``xᴴx``, the squared magnitude summed over the channels, ``(H, W')`` float32."""
    parts = x.view(np.float32).reshape(*x.shape, 2)
    return np.einsum("chwp,chwp->hw", parts, parts)


def correlate(a: Spectrum, b: Spectrum) -> Map:
    """Return ``aᴴb``, summed over the channels, ``(H, W')``."""
    product = np.conj(a)
    product *= b
    return product.sum(axis=0)


def solve(
    x: Spectrum,
    label: Map,
    scheme: Scheme,
    cells: tuple[int, int],
    temporal: Temporal | None = None,
    echo: tuple[Map, float] | None = None,
) -> Spectrum:
    """Train a filter on one sample.

    The auxiliary step after the last iteration has no effect on the filter, so it is left out; so are the terms that
    are zero in the first iteration.

    Args:
        x: the sample's spectrum ``(C, H, W')`` complex64.
        label: the label's spectrum ``(H, W')``, real or complex.
        scheme: penalties and auxiliary step.
        cells: ``(H, W)``.
        temporal: the previous filter and how strongly it pulls, if the tracker has this term.
        echo: ARCF-HC's ``M`` ``(H, W')`` and ``γ_M``.

    Returns:
        The filter's spectrum, ``(C, H, W')`` complex64. Its response to ``z`` is ``fᴴz`` at every frequency.
    """
    count = cells[0] * cells[1]
    power = energy(x)
    gain = (label / count).astype(x.dtype)
    ratio = 1.0
    if echo is not None:
        gain += (echo[1] * echo[0]).astype(x.dtype)
        ratio += echo[1]

    f: Spectrum | None = None
    mult: Spectrum | None = None
    aux: Spectrum | None = None
    for step, penalty in enumerate(scheme.penalties):
        pull = 0.0 if temporal is None else temporal.pull(f)
        rest = _rest(temporal, pull, penalty, aux, mult)
        f = _filter(x, power, gain, rest, penalty + pull, count * (penalty + pull) / ratio)
        if step + 1 < len(scheme.penalties):
            aux = _auxiliary(f, mult, penalty, scheme, cells)
            change = f - aux
            change *= np.float32(penalty)
            mult = change if mult is None else np.add(mult, change, out=mult)
    assert f is not None
    return f


def _rest(
    temporal: Temporal | None, pull: float, penalty: float, aux: Spectrum | None, mult: Spectrum | None
) -> Spectrum | None:
    """Return ``μ·f_prev + γ·aux − mult``, or None where all three are zero. Overwrites ``aux``."""
    rest: Spectrum | None = None
    if aux is not None and mult is not None:
        rest = np.multiply(aux, np.float32(penalty), out=aux)
        rest -= mult
    if temporal is not None and pull != 0:
        kept = temporal.previous * np.float32(pull)
        rest = kept if rest is None else np.add(rest, kept, out=rest)
    return rest


def _filter(x: Spectrum, power: Map, gain: Map, rest: Spectrum | None, c: float, td: float) -> Spectrum:
    """Return the closed form: ``(x·gain + rest − x·(power·gain + xᴴrest) / (power + T·d)) / c``.

    It is computed as ``x·(gain − …)/c + rest/c``, one map of the cells times the sample.
    """
    shared = power * gain
    if rest is not None:
        shared += correlate(x, rest)
    shared /= power + np.float32(td)
    factor = (gain - shared) / np.float32(c)
    f = x * factor
    if rest is not None:
        rest /= np.float32(c)
        f += rest
    return f


def _auxiliary(f: Spectrum, mult: Spectrum | None, penalty: float, scheme: Scheme, cells: tuple[int, int]) -> Spectrum:
    """Return the auxiliary filter: the transform of ``weights · inverse(γ·f + mult)``."""
    if mult is None:
        mixed = f * np.float32(penalty)
    elif scheme.scaled_multiplier:
        mixed = f + mult
        mixed *= np.float32(penalty)
    else:
        mixed = f * np.float32(penalty)
        mixed += mult
    space = scheme.transform.inverse(mixed, cells)
    space *= scheme.weights(penalty)
    return scheme.transform.forward(space)


def penalties(first: float, factor: float, largest: float, iterations: int) -> tuple[float, ...]:
    """Return the schedule ``γ ← min(factor·γ, largest)``; STRCF's largest lies below its first value."""
    values: list[float] = [first]
    while len(values) < iterations:
        values.append(min(factor * values[-1], largest))
    return tuple(values[:iterations])


def rectangle(cells: Sequence[int], small: Sequence[int]) -> NDArray[np.bool_]:
    """Return the mask ``(H, W)`` of the target: ``small`` cells, from ``floor(cells/2) − floor(small/2)``."""
    mask = np.zeros(tuple(cells), dtype=bool)
    rows, cols = (slice(max(n // 2 - s // 2, 0), n // 2 - s // 2 + s) for n, s in zip(cells, small, strict=True))
    mask[rows, cols] = True
    return mask
