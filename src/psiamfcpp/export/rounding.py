"""Weights as whole numbers of a step per filter, rounded so that errors cancel out."""

from __future__ import annotations

import numpy as np

from psiamfcpp.export.layers import Float32Array

LARGEST = 127
"""the largest weight in steps; the least is -127"""


def filter_steps(weight: Float32Array) -> Float32Array:
    """Return the step ``(outputs,)`` of each filter of a weight ``(outputs, inputs, k, k)``."""
    # A filter of zeros must not divide by zero.
    steps: Float32Array = np.maximum(np.abs(weight).max(axis=(1, 2, 3)) / LARGEST, 1e-12)
    return steps


def rounded(weight: Float32Array) -> Float32Array:
    """Round weights so that the errors of a filter cancel out, per input channel and in all.

    What reads a map of about one value sees the sum of its weights. Rounded to nearest, these sums are off by several
    steps; with few weights rounded the other way, by half a step (SQuant, Guo et al. 2022).

    Args:
        weight: ``(outputs, inputs, k, k)`` in steps, -127 to 127.

    Returns:
        Whole numbers of the same shape, each less than one and a half from its weight.
    """
    flat = weight.reshape(*weight.shape[:2], -1)
    whole = np.rint(flat)
    whole += _turned(flat - whole)
    # Of each input channel the weight that is off most in the direction of the filter's sum may turn too.
    left = flat - whole
    side = np.sign(left.sum(axis=(1, 2)))[:, None, None]
    place = (side * left).argmax(axis=2)[..., None]
    turn = _turned(np.take_along_axis(left, place, axis=2)[..., 0], left.sum(axis=(1, 2)))
    np.put_along_axis(whole, place, np.take_along_axis(whole, place, axis=2) + turn[..., None], axis=2)
    found: Float32Array = whole.clip(-LARGEST, LARGEST).reshape(weight.shape)
    return found


def _turned(errors: Float32Array, sums: Float32Array | None = None) -> Float32Array:
    """Return 1 or -1 for the errors ``(..., n)`` to turn, largest first, so that their sum is below a half."""
    sums = errors.sum(axis=-1) if sums is None else sums
    side = np.sign(sums)[..., None]
    place = np.argsort(np.argsort(-side * errors, axis=-1), axis=-1)
    return side * (place < np.abs(np.rint(sums))[..., None])
