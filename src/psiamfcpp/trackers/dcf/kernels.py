"""The loops over pixels, compiled by numba: fHOG, colour names, grey cells.

`features` is what to call; it checks and allocates. Loops are kept plain, so that the compiler can use vectors.
"""

from __future__ import annotations

import numba
import numpy as np

# Steps of the authors' table of orientations: a cosine times 10,000, truncated.
STEPS = 10_000
MARGIN = 10

# Where neither __pycache__ nor the user's cache folder can be written, numba refuses to cache: compile every time.
try:
    numba.njit(cache=True)(lambda: None)
    CACHE = True
except RuntimeError:
    CACHE = False

_compiled = numba.njit(cache=CACHE, error_model="numpy", fastmath={"contract", "nsz", "nnan", "ninf", "arcp"})


def _orientation_bins() -> np.ndarray:
    """Signed orientation bin by truncated cosine; row 0 for gradients that point down or level, row 1 for up.

    In single precision, as in the original: a gradient straight up or down lies on the edge between two bins. A cosine
    may exceed 1 by the error of the approximate root.
    """
    cosine = np.clip(np.arange(-STEPS - MARGIN, STEPS + MARGIN + 1) / STEPS, -1, 1)
    angle = np.minimum(np.arccos(cosine), np.pi - 1e-6).astype(np.float32)
    per_radian = np.float32(18) / np.float32(2 * np.pi)
    both = np.stack([angle, angle + np.float32(np.pi)])
    return ((both * per_radian + np.float32(0.5)).astype(np.int64) % 18).astype(np.uint8)


def _roots() -> np.ndarray:
    """Inverse root and root of numbers in [1, 4) as the authors' processor approximates them, in 2,048 steps.

    The original takes `rsqrtps` of the squared gradient, and `rcpps` of that. Intel's instructions give the value at
    the middle of a step, rounded: 1,024 steps in [1, 2) and in [2, 4) for the root, 2,048 in [1, 2) for the reciprocal.
    """

    def rounded(value: np.ndarray, steps: int) -> np.ndarray:
        mantissa, exponent = np.frexp(value)
        return np.ldexp(np.round(mantissa * steps) / steps, exponent)

    middle = 1 + (np.arange(1024) + 0.5) / 1024
    inverse = rounded(1 / np.sqrt(np.concatenate([middle, 2 * middle])), 8192)
    mantissa, exponent = np.frexp(inverse)
    step = 1 + (np.floor((2 * mantissa - 1) * 2048) + 0.5) / 2048
    return np.stack([inverse, np.ldexp(rounded(1 / step, 4096), 1 - exponent)]).astype(np.float32)


ORIENTATION_BINS = _orientation_bins()
ROOTS = _roots()


@_compiled
def fhog(images, bins, roots, approximate, cell, out):  # type: ignore[no-untyped-def]
    """Compute fHOG of images ``(n, h, w, C)``, uint8 or float32, into ``(n, 31, h // cell, w // cell)`` float32.

    Felzenszwalb et al. 2010, section 6, in Dollar's fast form: bilinear in space, no interpolation of orientations.
    With ``approximate``, square roots are those of `ROOTS`.
    """
    count, height, width, channels = images.shape
    rows, columns = height // cell, width // cell
    used_rows, used_columns = rows * cell, columns * cell
    epsilon = np.float32(1e-4 / (4 * cell**4))
    per_pixel = np.float32(1 / cell**2)
    half, zero, tiny, huge, cap = np.float32(0.5), np.float32(0), np.float32(1e-10), np.float32(1e10), np.float32(0.2)
    # Votes into a grid with a margin, so that those outside need no test.
    votes = np.empty((rows + 2, columns + 2, 18), np.float32)
    signed = np.empty((18, rows, columns), np.float32)
    norms = np.empty((rows + 1, columns + 1), np.float32)
    energy = np.empty((rows, columns), np.float32)
    lines = np.empty((3, channels, width), np.float32)
    best, best_x, best_y = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    bits, steps, powers = best.view(np.int32), np.empty(width, np.int32), np.empty((2, width), np.int32)
    scales = powers.view(np.float32)
    place = np.empty(width, np.int64)
    left, right = np.empty(width, np.float32), np.empty(width, np.float32)
    for x in range(used_columns):
        at = (x + 0.5) / cell - 0.5
        place[x] = int(np.floor(at)) + 1
        right[x] = at - np.floor(at)
        left[x] = 1 - right[x]

    for n in range(count):
        votes[:] = 0
        for y in range(used_rows):
            # lines[(y - 1 .. y + 1) % 3] hold the row and its neighbours, one channel after the other
            for row in range(0 if y == 0 else y + 1, min(y + 2, height)):
                for c in range(channels):
                    for x in range(width):
                        lines[row % 3, c, x] = images[n, row, x, c]
            above, below = max(y - 1, 0), min(y + 1, height - 1)
            across = half if below - above == 2 else np.float32(1)
            best[:] = -1
            # Frames are BGR; of equal gradients the authors keep that of the earlier channel in RGB.
            for c in range(channels - 1, -1, -1):
                here, up, down = lines[y % 3, c], lines[above % 3, c], lines[below % 3, c]
                for x in range(1, width - 1):
                    gx = (here[x + 1] - here[x - 1]) * half
                    gy = (down[x] - up[x]) * across
                    square = gx * gx + gy * gy
                    larger = square > best[x]
                    best[x] = square if larger else best[x]
                    best_x[x] = gx if larger else best_x[x]
                    best_y[x] = gy if larger else best_y[x]
                for x in (0, width - 1):
                    gx = here[min(x + 1, width - 1)] - here[max(x - 1, 0)]
                    gy = (down[x] - up[x]) * across
                    square = gx * gx + gy * gy
                    if square > best[x]:
                        best[x], best_x[x], best_y[x] = square, gx, gy
            at = (y + 0.5) / cell - 0.5
            top = int(np.floor(at)) + 1
            low = np.float32(at - np.floor(at))
            high = np.float32(1) - low
            if approximate:
                for x in range(used_columns):
                    # the lowest bit of the exponent and ten of the mantissa choose the step, the rest scales it
                    steps[x] = ((bits[x] >> 13) & 2047) ^ 1024
                    half_exponent = ((bits[x] >> 23) - 127) >> 1
                    powers[0, x], powers[1, x] = (127 - half_exponent) << 23, (127 + half_exponent) << 23
                for x in range(used_columns):
                    inverse = min(roots[0, steps[x]] * scales[0, x], huge)
                    best[x] = max(roots[1, steps[x]] * scales[1, x], tiny) if best[x] > zero else tiny
                    best_x[x] = best_x[x] * inverse * np.float32(STEPS)
            else:
                for x in range(used_columns):
                    best[x] = max(np.sqrt(best[x]), tiny)
                    best_x[x] = best_x[x] / best[x] * np.float32(STEPS)
            for x in range(used_columns):
                up_half = 1 if best_y[x] < zero else 0
                cosine = -best_x[x] if up_half else best_x[x]
                k = bins[up_half, int(cosine) + STEPS + MARGIN]
                weight = best[x] * per_pixel
                weight_left, weight_right, column = weight * left[x], weight * right[x], place[x]
                votes[top, column, k] += high * weight_left
                votes[top, column + 1, k] += high * weight_right
                votes[top + 1, column, k] += low * weight_left
                votes[top + 1, column + 1, k] += low * weight_right

        # Border cells get votes from one side only: 8/7 makes up for it, twice in the corners.
        edge = np.float32(8 / 7)
        for y in range(rows):
            lift_y = (edge if y == 0 else np.float32(1)) * (edge if y == rows - 1 else np.float32(1))
            for x in range(columns):
                lift = lift_y * (edge if x == 0 else np.float32(1)) * (edge if x == columns - 1 else np.float32(1))
                total = zero
                for k in range(9):
                    one, other = votes[y + 1, x + 1, k] * lift, votes[y + 1, x + 1, k + 9] * lift
                    signed[k, y, x], signed[k + 9, y, x] = one, other
                    total += (one + other) * (one + other)
                energy[y, x] = total
        # norms[y, x]: of the corner above left of cell (y, x); on the border that of the nearest inner corner.
        for y in range(rows + 1):
            a = min(max(y - 1, 0), max(rows - 2, 0))
            for x in range(columns + 1):
                b = min(max(x - 1, 0), max(columns - 2, 0))
                a1, b1 = min(a + 1, rows - 1), min(b + 1, columns - 1)
                block = energy[a, b] + energy[a1, b] + energy[a, b1] + energy[a1, b1]
                norms[y, x] = np.float32(1) / np.sqrt(block + epsilon)
        texture = np.float32(0.2357)
        for y in range(rows):
            out[n, 27:31, y] = 0
            n1, n2, n3, n4 = norms[y + 1, 1:], norms[y, 1:], norms[y + 1, :-1], norms[y, :-1]
            t1, t2, t3, t4 = out[n, 27, y], out[n, 28, y], out[n, 29, y], out[n, 30, y]
            for k in range(18):
                r, o = signed[k, y], out[n, k, y]
                for x in range(columns):
                    v1, v2 = min(r[x] * n1[x], cap), min(r[x] * n2[x], cap)
                    v3, v4 = min(r[x] * n3[x], cap), min(r[x] * n4[x], cap)
                    o[x] = half * (v1 + v2 + v3 + v4)
                    t1[x] += texture * v1
                    t2[x] += texture * v2
                    t3[x] += texture * v3
                    t4[x] += texture * v4
            for k in range(9):
                r, q, o = signed[k, y], signed[k + 9, y], out[n, 18 + k, y]
                for x in range(columns):
                    s = r[x] + q[x]
                    v1, v2 = min(s * n1[x], cap), min(s * n2[x], cap)
                    v3, v4 = min(s * n3[x], cap), min(s * n4[x], cap)
                    o[x] = half * (v1 + v2 + v3 + v4)


@_compiled
def table_cells(image, table, cell, out):  # type: ignore[no-untyped-def]
    """Means over cells of the rows of a table ``(32768, K)`` by colour, into ``(K, h // cell, w // cell)``.

    Args:
        image: ``(h, w, 3)`` uint8, BGR. The row is ``R // 8 + 32 (G // 8) + 1024 (B // 8)``.
        table: float32.
        cell: side of a cell in pixels.
        out: float32.
    """
    names, rows, columns = out.shape
    share = np.float32(1 / cell**2)
    total = np.empty(names, np.float32)
    for y in range(rows):
        for x in range(columns):
            total[:] = 0
            for i in range(y * cell, (y + 1) * cell):
                for j in range(x * cell, (x + 1) * cell):
                    row = (image[i, j, 2] >> 3) + ((image[i, j, 1] >> 3) << 5) + ((image[i, j, 0] >> 3) << 10)
                    for k in range(names):
                        total[k] += table[row, k]
            for k in range(names):
                out[k, y, x] = total[k] * share
