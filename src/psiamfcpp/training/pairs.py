"""Training pairs: a template crop of a target, and a search crop that holds it (or, in a negative pair, does not).

Pair number ``i`` depends on the seed and on ``i`` alone, so that a resumed run sees what it would have seen.
"""

from __future__ import annotations

import math
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from psiamfcpp.crop import Colour, crop, warp
from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import Frame, FrameStore
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray, Image, centre
from psiamfcpp.models.arch import DEFAULT, Architecture, architecture, opened
from psiamfcpp.training import augment
from psiamfcpp.training.options import PairOptions

Corners = tuple[float, float, float, float]

_DEFAULT = architecture(DEFAULT)

# Objects with a smaller geometric mean side hold too few pixels to be distinguished from their surroundings.
_SMALLEST_SIDE = 5.0


@dataclass(frozen=True)
class Pair:
    """One sample."""

    template: Image
    """``(Z, Z, 3)`` uint8, BGR"""
    search: Image
    """``(S, S, 3)`` uint8, BGR"""
    corners: Corners
    """x0, y0, x1, y1 of the target in the search crop, pixels; may lie outside it"""
    present: bool
    """False where the search crop shows another object"""
    side: float = 0.0
    """root of the target's area in the template's frame, pixels"""


class PairSampler:
    """Draws pairs from sequences, source by source.

    A source's weight is the square root of the number of its images or clips, so that large ones count more but
    drown nobody. Images of a source are equally likely, however many objects they hold.
    """

    def __init__(
        self,
        sequences: list[Sequence],
        options: PairOptions,
        seed: int = 0,
        cache_bytes: int = 0,
        store: FrameStore | None = None,
        arch: Architecture = _DEFAULT,
    ):
        """Prepare to draw.

        Args:
            sequences: what to draw from.
            options: how to draw.
            seed: seed of every pair.
            cache_bytes: decoded images kept in memory, bytes.
            store: where frames of videos are decoded to; by default a temporary folder.
            arch: architecture whose crops to make.

        Raises:
            UserError: no sequence has a usable box, or the architecture takes no search crops of the size.
        """
        self.options = options
        self.seed = seed
        self._arch = arch
        self._reach = (arch.score_size(options.search_size) + 1) / 2 * arch.stride
        self._images = ImageCache(cache_bytes, store or FrameStore(), opened(arch.procedure).fill)
        targets = [t for t in (_Target(s, _usable_rows(s)) for s in sequences) if len(t.rows)]
        if not targets:
            raise UserError("the training data hold no usable box: check the folders given")
        clips, stills = [t for t in targets if t.is_clip], [t for t in targets if not t.is_clip]
        self._kinds = [_Kind(group) for group in (clips, stills) if group]

    def pair(self, index: int) -> Pair:
        """Pair number ``index``."""
        rng = np.random.default_rng([self.seed, index])
        kind = self._kinds[0] if len(self._kinds) == 1 or rng.random() < self.options.clip_share else self._kinds[1]
        target = kind.draw(rng)
        first, second = self._rows(target, rng)
        other, row, present = target, second, True
        if rng.random() < self.options.negatives:
            other, row, present = self._negative(kind, target, second, rng)
        return self._crops(target, first, other, row, present, rng)

    def _rows(self, target: _Target, rng: Generator) -> tuple[int, int]:
        """Frames of the template and of the search crop, at most ``max_gap`` apart."""
        rows = target.rows
        first = _pick(rows, rng)
        low = np.searchsorted(rows, first - self.options.max_gap)
        high = np.searchsorted(rows, first + self.options.max_gap, side="right")
        return first, _pick(rows[low:high], rng)

    def _negative(self, kind: _Kind, target: _Target, row: int, rng: Generator) -> tuple[_Target, int, bool]:
        """Where to look instead: at another object of the image, or at another image, of the same source or not.

        In the first case the target counts as present: it is, though mostly too far off for any cell.
        """
        neighbours = kind.beside(target, row)
        if neighbours and rng.random() < 0.7:
            return neighbours[int(rng.integers(len(neighbours)))], row, True
        for _ in range(10):
            other = kind.draw(rng, target.sequence.source if rng.random() < 0.5 else None)
            if other.sequence.frames[0] != target.sequence.frames[0]:
                return other, _pick(other.rows, rng), False
        return target, row, True

    def _crops(self, target: _Target, first: int, other: _Target, row: int, present: bool, rng: Generator) -> Pair:
        """Both crops, changed as the options say, and where the target lies in the second."""
        strength, size = self.options.augmentation, self.options.search_size
        z_frame, z_box = target.at(first)
        x_frame, x_box = other.at(row)
        flip = -1.0 if rng.random() < 0.5 and strength else 1.0
        z_size = self._arch.template_size
        z_map = crop_map(z_box, z_size, _template_jitter(strength, flip, rng), self._arch)
        template = self._show(z_frame, z_map, z_size, rng)
        if rng.random() < 0.1 * strength:
            template = augment.transplant(template, box_in_crop(z_box, z_map), self._backdrop(z_size, rng))
        x_map = crop_map(x_box, size, _search_jitter(self.options, self._reach, target.is_clip, flip, rng), self._arch)
        search = self._show(x_frame, x_map, size, rng)
        corners = box_in_crop(target.at(row)[1] if present else x_box, x_map)
        if strength:
            if rng.random() < 0.2 * strength:
                search = augment.transplant(search, corners, self._backdrop(size, rng))
            if rng.random() < 0.25 * strength:
                search = self._with_distractor(search, corners, target, rng)
            if rng.random() < 0.12 * strength:
                search = augment.occlude(search, corners, rng)
            template = augment.photometric(template, rng, 0.6 * strength)
            search = augment.photometric(search, rng, strength)
            if rng.random() < 0.08:
                template, search = augment.grey(template), augment.grey(search)
        return Pair(template, search, corners, present, math.sqrt(float(z_box[2] * z_box[3])))

    def _show(self, frame: Frame, to_frame: NDArray[np.float64], size: int, rng: Generator) -> Image:
        """A crop; where much of it lies outside the frame, mostly another one shows there instead of one colour.

        A plain border would teach that whatever has texture is the target.
        """
        image, fill = self._images.get(frame)
        shown = warp(image, to_frame, size, fill)
        if rng.random() >= 0.7 * self.options.augmentation or _inside(to_frame, size, image.shape):
            return shown
        inside = warp(np.full(image.shape[:2], 255, np.uint8), to_frame, size, (0, 0, 0)) > 127
        if np.count_nonzero(inside) > 0.85 * inside.size:
            return shown
        backdrop = self._backdrop(size, rng)
        cv2.copyTo(shown, inside.astype(np.uint8), backdrop)
        return backdrop

    def _with_distractor(self, search: Image, corners: Corners, target: _Target, rng: Generator) -> Image:
        """The search crop with one more object in it, half the time of the target's own source; clear of the target."""
        kind = self._kinds[0 if target.is_clip else -1]
        other = kind.draw(rng, target.sequence.source if rng.random() < 0.5 else None)
        if other.sequence.frames[0] == target.sequence.frames[0]:
            return search
        frame, box = other.at(_pick(other.rows, rng))
        size = search.shape[0]
        dx, dy = rng.uniform(-size / 2, size / 2, 2)
        jitter = Jitter(dx, dy, math.exp(rng.uniform(-0.4, 0.4)), rng.choice([-1.0, 1.0]))
        to_frame = crop_map(box, size, jitter, self._arch)
        x0, y0, x1, y1 = place = box_in_crop(box, to_frame)
        if x0 < corners[2] and x1 > corners[0] and y0 < corners[3] and y1 > corners[1]:
            return search
        image, fill = self._images.get(frame)
        return augment.transplant(warp(image, to_frame, size, fill), place, search)

    def _backdrop(self, size: int, rng: Generator) -> Image:
        """A random square of a random frame."""
        scene = self._kinds[int(rng.integers(len(self._kinds)))].draw(rng).sequence
        image, fill = self._images.get(scene.frames[int(rng.integers(len(scene)))])
        height, width = image.shape[:2]
        side = min(height, width) * rng.uniform(0.4, 1.0)
        cx, cy = rng.uniform(side / 2, width - side / 2), rng.uniform(side / 2, height - side / 2)
        return crop(image, cx, cy, side, size, fill)


@dataclass(frozen=True, eq=False, slots=True)
class _Target:
    """A sequence with its usable rows."""

    sequence: Sequence
    rows: NDArray[np.intp]

    @property
    def is_clip(self) -> bool:
        return len(self.sequence) > 1

    def at(self, row: int) -> tuple[Frame, FloatArray]:
        """Frame and box of a row."""
        return self.sequence.frames[row], self.sequence.boxes[row]

    def has(self, row: int) -> bool:
        """Whether a row is usable."""
        place = int(np.searchsorted(self.rows, row))
        return place < len(self.rows) and bool(self.rows[place] == row)


class _Kind:
    """Clips, or photographs: their sources with the weight of each."""

    def __init__(self, targets: list[_Target]):
        self._pictures: dict[Frame, list[_Target]] = defaultdict(list)
        for target in targets:
            self._pictures[target.sequence.frames[0]].append(target)
        self._sources: dict[str, list[list[_Target]]] = defaultdict(list)
        for group in self._pictures.values():
            self._sources[group[0].sequence.source].append(group)
        self._names = sorted(self._sources)
        shares = np.sqrt([len(self._sources[name]) for name in self._names]).cumsum()
        self._up_to = shares / shares[-1]

    def draw(self, rng: Generator, source: str | None = None) -> _Target:
        """An object of an image of a source; of the given source, if there is an image filed under it."""
        if source not in self._sources:
            source = self._names[int(np.searchsorted(self._up_to, rng.random(), side="right"))]
        images = self._sources[source]
        image = images[int(rng.integers(len(images)))]
        return image[int(rng.integers(len(image)))]

    def beside(self, target: _Target, row: int) -> list[_Target]:
        """The other labelled objects of the frame that shows a target in a row of its own."""
        frame = target.sequence.frames[row]
        others = self._pictures[target.sequence.frames[0]]
        return [t for t in others if t is not target and t.has(row) and t.sequence.frames[row] == frame]


@dataclass(frozen=True)
class Jitter:
    """Where the target comes to lie in a crop, against the middle and upright."""

    dx: float = 0.0
    """shift to the right, pixels of the crop"""
    dy: float = 0.0
    """shift down, pixels of the crop"""
    scale: float = 1.0
    """size of the target against the one that its context gives it"""
    flip: float = 1.0
    """-1 mirrors left and right"""
    angle: float = 0.0
    """turn, radians"""
    aspect: float = 1.0
    """factor on the width, divided from the height"""


def _template_jitter(strength: float, flip: float, rng: Generator) -> Jitter:
    """A little inexactness, as of a box drawn by hand."""
    dx, dy = rng.normal(0, 2.0, 2) * strength
    return Jitter(dx, dy, math.exp(rng.uniform(-0.06, 0.06) * strength), flip)


def _search_jitter(options: PairOptions, reach: float, is_clip: bool, flip: float, rng: Generator) -> Jitter:
    """Shift within the score map's reach, and scale; turn mostly where both crops show the same image."""
    # From above, targets turn as far as they like; most other changes of a camera's roll are small.
    turned = rng.random() < (0.3 if is_clip else 0.5)
    turn = rng.uniform(-np.pi / 2, np.pi / 2) if rng.random() < 0.2 else rng.normal(0, 0.22)
    reach = min(options.shift * options.search_size / 2, reach)
    dx, dy = rng.uniform(-reach, reach, 2)
    return Jitter(
        dx,
        dy,
        math.exp(rng.uniform(-1, 1) * math.log1p(options.scale)),
        flip,
        turn * turned * options.augmentation,
        math.exp(rng.uniform(-0.12, 0.12) * options.augmentation),
    )


def crop_map(box: FloatArray, size: int, jitter: Jitter, arch: Architecture = _DEFAULT) -> NDArray[np.float64]:
    """The 2x3 map from pixels of a crop of ``size`` to the frame that shows a box with its context.

    With no jitter this is the crop of the tracking procedure before its side is rounded: for SiamFC++, context of one
    side to 127 pixels of template.
    """
    cx, cy = centre(box)
    side = arch.context(float(box[2]), float(box[3])) * size / arch.template_size
    scale = (side - arch.edge) / (size - arch.edge) / jitter.scale
    cos, sin = math.cos(jitter.angle), math.sin(jitter.angle)
    linear = scale * np.array([[cos, -sin], [sin, cos]]) @ np.diag([jitter.flip / jitter.aspect, jitter.aspect])
    middle = (size - 1) / 2 + np.array([jitter.dx, jitter.dy])
    return np.column_stack([linear, np.array([cx, cy]) - linear @ middle])


def box_in_crop(box: FloatArray, to_frame: NDArray[np.float64]) -> Corners:
    """Corners in the crop of a box in the frame.

    Under rotation these bound the ellipse inscribed in the box: the box of a turned box would be too large for
    nearly every object.
    """
    to_crop = np.linalg.inv(to_frame[:, :2])
    cx, cy = to_crop @ (centre(box) - to_frame[:, 2])
    rx, ry = np.sqrt((to_crop**2) @ ((box[2:] - 1) / 2) ** 2)
    return (float(cx - rx), float(cy - ry), float(cx + rx), float(cy + ry))


class ImageCache:
    """Keeps decoded images, with what is shown beyond them, up to a number of bytes; oldest use is dropped first."""

    def __init__(self, limit: int, store: FrameStore, fill: Callable[[Image], Colour]):
        self._limit = limit
        self._store = store
        self._fill = fill
        self._held: OrderedDict[Frame, tuple[Image, Colour]] = OrderedDict()
        self._bytes = 0

    def get(self, frame: Frame) -> tuple[Image, Colour]:
        """A frame, ``(H, W, 3)`` uint8, BGR, not to be written to; and the colour of what lies outside it."""
        if frame in self._held:
            self._held.move_to_end(frame)
            return self._held[frame]
        image = self._store.read(frame)
        self._held[frame] = found = image, self._fill(image)
        self._bytes += image.nbytes
        while self._bytes > self._limit and self._held:
            self._bytes -= self._held.popitem(last=False)[1][0].nbytes
        return found


def _pick(rows: NDArray[np.intp], rng: Generator) -> int:
    return int(rows[int(rng.integers(len(rows)))])


def _inside(to_frame: NDArray[np.float64], size: int, shape: tuple[int, ...]) -> bool:
    """Whether a square crop lies wholly inside an image ``(H, W, ...)``: its four corners do."""
    end = size - 1
    corners = to_frame @ np.array([[0, end, 0, end], [0, 0, end, end], [1, 1, 1, 1]])
    height, width = shape[:2]
    return bool((corners >= 0).all() and (corners[0] <= width - 1).all() and (corners[1] <= height - 1).all())


def _usable_rows(sequence: Sequence) -> NDArray[np.intp]:
    """Frames whose box is finite and not too small."""
    rows = sequence.usable()
    return rows[np.sqrt(sequence.boxes[rows, 2:].prod(axis=1)) >= _SMALLEST_SIDE]
