"""ECO-HC: efficient convolution operators on hand-crafted features (Danelljan, Bhat, Khan, Felsberg, CVPR 2017)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psiamfcpp.geometry import Box, FloatArray, Image
from psiamfcpp.trackers.dcf import eco, fourier
from psiamfcpp.trackers.dcf.eco import Bundle
from psiamfcpp.trackers.dcf.features import colour_names, fhog, grey_cells, normalise_energy
from psiamfcpp.trackers.dcf.geometry import (
    centred_box,
    crop,
    is_grey,
    position_and_size,
    resize_bilinear,
    round_half_away,
    scale_limits,
)
from psiamfcpp.trackers.dcf.scales import FastScaleConstants, FastScaleFilter


@dataclass(frozen=True, slots=True)
class EcoHcConstants:
    """Constants of the authors' run file for hand-crafted features."""

    hog_cell_size: int = 6
    hog_compressed_dim: int = 10
    cn_cell_size: int = 4
    cn_compressed_dim: int = 3
    search_area_scale: float = 4
    min_image_sample_size: int = 150**2
    max_image_sample_size: int = 200**2
    newton_iterations: int = 5
    output_sigma_factor: float = 1 / 16
    learning_rate: float = 0.009
    n_samples: int = 30
    train_gap: int = 5
    skip_after_frame: int = 10
    interpolation_bicubic_a: float = -0.75
    reg_window_min: float = 1e-4
    reg_window_edge: float = 10e-3
    reg_sparsity_threshold: float = 0.05
    cg_iter: int = 5
    cg_forgetting_rate: float = 50
    init_cg_iter: int = 10 * 15
    init_gn_iter: int = 10
    projection_reg: float = 1e-7
    precond_data_param: float = 0.75
    precond_reg_param: float = 0.25
    precond_proj_param: float = 40
    scale: FastScaleConstants = field(
        default_factory=lambda: FastScaleConstants(smallest_side=8, do_poly_interp=True, decimate=True)
    )


class EcoHc:
    """Continuous filter on compressed fHOG and colour names, trained on a set of samples by conjugate gradients.

    In a grey sequence the grey cell mean takes the place of the colour names. The authors use a table of
    intensities there, which no benchmark for UAVs needs.
    """

    def __init__(self, frame: Image, box: Box, constants: EcoHcConstants):
        self._constants = c = constants
        corner, size = position_and_size(box)
        self._position = corner + (size - 1) / 2
        area = math.prod(size * c.search_area_scale)
        self._scale = math.sqrt(area / min(max(area, c.min_image_sample_size), c.max_image_sample_size))
        self._base = size / self._scale
        self._side = side = window_side(
            math.sqrt(math.prod(self._base * c.search_area_scale)), c.hog_cell_size, c.cn_cell_size
        )
        self._grey = is_grey(frame)

        cells = [side // c.cn_cell_size, side // c.hog_cell_size]
        self._windows = [fourier.hann2((n, n), inner=True).astype(np.float32) for n in cells]
        self._grids = [n + 1 - n % 2 for n in cells]
        self._interpolations = [eco.interpolation(n, c.interpolation_bicubic_a) for n in self._grids]
        output = max(self._grids)
        # The label's width is given in pixels of the window; the spectrum wants it in periods.
        sigma = math.sqrt(math.prod(np.maximum(np.floor(self._base), 1))) * c.output_sigma_factor / side
        self._labels = [eco.label(n, sigma) for n in self._grids]
        self._output = output
        regulariser = eco.Regulariser(side, self._base, c.reg_window_edge, c.reg_window_min, c.reg_sparsity_threshold)
        self._penalties = [regulariser.operator(n) for n in self._grids]
        self._penalty_energy = regulariser.energy

        self._space = eco.SampleSpace(c.n_samples, c.learning_rate)
        self._momentum: eco.Momentum | None = None
        self._frame, self._untrained = 1, 0
        self._start(frame)
        limits = scale_limits(c.scale.scale_step, (side, side), self._base, frame.shape[:2])
        self._scales = FastScaleFilter(c.scale, self._base, limits, model_of=size)
        self._scales.train(frame, self._position, self._scale)

    def update(self, frame: Image) -> tuple[Box, NDArray[Any]]:
        """The box in the next frame, and the response that it was found in."""
        c = self._constants
        self._frame += 1
        around, scale = round_half_away(self._position), self._scale
        sample = self._spectra(self._project(self._features(frame, around, scale)))
        scores = eco.complete(self._scores(sample))
        shift, _, _ = fourier.newton_peak(scores[None], c.newton_iterations)
        self._position = around + shift * self._side / self._output * scale
        self._scale = self._scales.follow(frame, self._position, scale)

        sample = self._moved(sample, self._position - around, scale)
        self._space.add(sample)
        if self._frame < c.skip_after_frame or self._untrained >= c.train_gap:
            self._train(sample)
            self._untrained = 0
        else:
            self._untrained += 1
        self._scales.train(frame, self._position, self._scale)

        box = centred_box(self._position, self._base * self._scale)
        return box, fourier.irfft2(scores, (self._output, self._output))

    def _features(self, frame: Image, position: FloatArray, scale: float) -> Bundle:
        """Normalised feature maps, neither compressed nor windowed."""
        c = self._constants
        patch = sample_patch(frame, position, scale, self._side)
        hog = fhog(patch[..., 2] if self._grey else patch, c.hog_cell_size, sse=True)
        colour = grey_cells(patch, c.cn_cell_size)[None] if self._grey else colour_names(patch, c.cn_cell_size)
        return [normalise_energy(colour), normalise_energy(hog)]

    def _project(self, maps: Bundle) -> Bundle:
        return [eco_project(p, m) for p, m in zip(self._projections, maps, strict=True)]

    def _spectra(self, maps: Bundle) -> Bundle:
        parts = zip(maps, self._windows, self._interpolations, strict=True)
        return [eco.centred(m * window) * factor for m, window, factor in parts]

    def _moved(self, sample: Bundle, by: FloatArray, scale: float) -> Bundle:
        """The sample as if it had been cut ``by`` pixels further on."""
        turn = 2 * np.pi * by / (scale * self._side)
        return [part * eco.shift(n, turn) for part, n in zip(sample, self._grids, strict=True)]

    def _scores(self, sample: Bundle) -> eco.Array:
        return eco.merge([(f * x).sum(axis=0) for f, x in zip(self._filter, sample, strict=True)], self._output)

    def _start(self, frame: Image) -> None:
        """Learn compression and filter from the first frame (section 3.2)."""
        c = self._constants
        around = round_half_away(self._position)
        maps = self._features(frame, around, self._scale)
        dims = (c.cn_compressed_dim, c.hog_compressed_dim)
        self._projections = [principal_axes(m, min(d, len(m))) for m, d in zip(maps, dims, strict=True)]
        raw = self._moved(self._spectra(maps), self._position - around, self._scale)
        sample = self._project(raw)
        self._energy = [np.square(np.abs(part)) for part in sample]
        self._space.add(sample)
        self._filter = [np.zeros_like(part) for part in sample]
        for _ in range(c.init_gn_iter):
            self._joint_step(raw)
        # Further training starts from the sample in the new compression.
        self._space.put(0, self._project(raw))

    def _joint_step(self, raw: Bundle) -> None:
        """One Gauss-Newton step on filter and compression together; a bundle holds both, filters first."""
        c = self._constants
        blocks, before, projections = len(raw), self._filter, self._projections
        projected = self._project(raw)
        flat = [x.reshape(len(x), -1) for x in raw]

        def backward(residuals: Bundle) -> Bundle:
            """Transpose of the response's derivative, applied to a residual on each block's grid."""
            filters = [x.conj() * r for x, r in zip(projected, residuals, strict=True)]
            matrices = []
            for x, f, r in zip(flat, before, residuals, strict=True):
                turned = f.conj() * r
                # The authors' code leaves frequency 0 of the columns out of this sum.
                turned[..., 0] = 0
                matrices.append(2 * (x.conj() @ turned.reshape(len(f), -1).T).real)
            return filters + matrices

        def operator(v: Bundle) -> Bundle:
            filters, changes = v[:blocks], v[blocks:]
            parts = []
            for x, p, f, f0, change in zip(raw, projected, filters, before, changes, strict=True):
                mixed = (change.astype(np.complex64) @ f0.reshape(len(f0), -1)).reshape(x.shape)
                parts.append((p * f).sum(axis=0) + (x * mixed).sum(axis=0))
            total = eco.merge(parts, self._output)
            out = backward([eco.middle(total, n) for n in self._grids])
            for i, penalty in enumerate(self._penalties):
                out[i] = out[i] + penalty(filters[i])
                out[blocks + i] = out[blocks + i] + np.float32(c.projection_reg) * changes[i]
            return out

        right = backward([y.astype(np.complex64) for y in self._labels])
        for i, p in enumerate(projections):
            right[blocks + i] = right[blocks + i] - np.float32(c.projection_reg) * p
        channels = sum(len(x) for x in raw)
        shrink = [
            np.float32(1 / (c.precond_proj_param * (2 * float((y**2).sum()) / channels + c.projection_reg)))
            for y in self._labels
        ]
        diagonal = self._diagonal()
        start = [*before, *(np.zeros_like(p) for p in projections)]
        found, _ = eco.conjugate_gradients(
            operator,
            right,
            lambda v: (
                [a / b for a, b in zip(v[:blocks], diagonal, strict=True)]
                + [a * b for a, b in zip(v[blocks:], shrink, strict=True)]
            ),
            lambda a, b: (
                _product(a[:blocks], b[:blocks])
                + sum(float(np.vdot(x, y)) for x, y in zip(a[blocks:], b[blocks:], strict=True))
            ),
            start,
            c.init_cg_iter // c.init_gn_iter,
            fletcher_reeves=True,
        )
        self._filter = [_hermitian(f) for f in found[:blocks]]
        self._projections = [p + change for p, change in zip(projections, found[blocks:], strict=True)]

    def _diagonal(self) -> Bundle:
        """Diagonal of the preconditioner, from the energy of the samples."""
        c = self._constants
        data, penalty = 1 - c.precond_reg_param, c.precond_reg_param * self._penalty_energy
        return [
            data * (c.precond_data_param * e + (1 - c.precond_data_param) * e.mean(axis=0)) + np.float32(penalty)
            for e in self._energy
        ]

    def _train(self, sample: Bundle) -> None:
        """Some steps of conjugate gradients on all samples (section 3.1)."""
        c = self._constants
        rate = np.float32(c.learning_rate)
        for energy, part in zip(self._energy, sample, strict=True):
            energy += rate * (np.square(np.abs(part)) - energy)
        blocks, weights = self._space.samples()
        share = weights.astype(np.float32)
        weighted = [b.conj() * share[:, None, None, None] for b in blocks]

        def operator(filters: Bundle) -> Bundle:
            total = eco.merge([(b * f).sum(axis=1) for b, f in zip(blocks, filters, strict=True)], self._output)
            parts = zip(weighted, self._grids, filters, self._penalties, strict=True)
            return [(w * eco.middle(total, n)[:, None]).sum(axis=0) + penalty(f) for w, n, f, penalty in parts]

        right = [w.sum(axis=0) * y for w, y in zip(weighted, self._labels, strict=True)]
        diagonal = self._diagonal()
        if self._momentum is not None:
            self._momentum.rho /= (1 - c.learning_rate) ** c.cg_forgetting_rate
        self._filter, self._momentum = eco.conjugate_gradients(
            operator,
            right,
            lambda v: [a / b for a, b in zip(v, diagonal, strict=True)],
            _product,
            self._filter,
            c.cg_iter,
            self._momentum,
        )


def window_side(side: float, hog_cell: int, cn_cell: int) -> int:
    """Side of the window in pixels: near the given one, such that most feature maps have odd sides."""
    start = int(1 + 2 * round_half_away(side / (2 * hog_cell))) * hog_cell
    odd = [(start + a) // hog_cell % 2 + (start + a) // cn_cell % 2 for a in range(hog_cell)]
    return start + odd.index(max(odd))


def sample_patch(frame: Image, position: FloatArray, scale: float, side: int) -> Image:
    """Patch ``(side, side, 3)`` about a position (row, column, 1-based): every n-th pixel first, then bilinear."""
    position = np.floor(position)
    step = max(math.floor(scale - 0.1), 1)
    if step > 1:
        rest = np.mod(position - 1, step)
        position = (position - 1 - rest) / step + 1
        frame = frame[int(rest[0]) :: step, int(rest[1]) :: step]
    size = max(int(round_half_away(side * scale / step)), 2)
    return resize_bilinear(crop(frame, position, (size, size), shift=1), (side, side))


def principal_axes(maps: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """First principal axes of the vectors of feature maps ``(D, h, w)``, as columns ``(D, count)``."""
    vectors = maps.reshape(len(maps), -1).astype(np.float64)
    vectors = vectors - vectors.mean(axis=1, keepdims=True)
    return np.linalg.svd(vectors @ vectors.T)[0][:, :count].astype(np.float32)


def eco_project(projection: NDArray[np.float32], maps: NDArray[Any]) -> NDArray[Any]:
    """Compress maps or spectra ``(D, h, w)`` by a matrix ``(D, C)`` to ``(C, h, w)``."""
    flat = projection.T.astype(maps.dtype) @ maps.reshape(len(maps), -1)
    return flat.reshape(-1, *maps.shape[1:])


def _product(a: Bundle, b: Bundle) -> float:
    return sum(eco.inner(x, y) for x, y in zip(a, b, strict=True))


def _hermitian(f: NDArray[Any]) -> NDArray[Any]:
    """Make the column of frequency 0 that of a real filter, which rounding has spoilt."""
    f = f.copy()
    middle = f.shape[-2] // 2
    f[..., :middle, 0] = f[..., :middle:-1, 0].conj()
    return f
