"""What a large tracker says of numbered pairs, computed once and stored: pair ``i`` is always the same pair.

The teacher is LightFC (Li et al. 2024), whose search region of four times the target's side nearly is that of a crop of
ours. It looks at the crops themselves, so that it sees what the network in training sees.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from psiamfcpp.errors import UserError, brief
from psiamfcpp.geometry import Image, context_side, from_corners, overlap
from psiamfcpp.models.network import Maps, cell_grid
from psiamfcpp.training.losses import iou
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import Pair, PairSampler

Array = NDArray[np.float32]
Look = Callable[[Image, Image], tuple[Array, Array, Array]]
"""From a template ``(128, 128, 3)`` and a search region ``(256, 256, 3)``, BGR, to LightFC's score ``(16, 16)``,
size ``(2, 16, 16)`` as shares of the region and offset ``(2, 16, 16)`` in cells"""

CELLS = 16
TEMPLATE, REGION = 128, 256
# ImageNet's, for RGB in 0..255.
_MEAN = np.array([0.485, 0.456, 0.406], np.float32) * 255
_STD = np.array([0.229, 0.224, 0.225], np.float32) * 255
LEAST_OVERLAP = 0.5
SMALLEST_SIDE = 10.0


@dataclass(frozen=True)
class Said:
    """What the teacher says of one pair, or of a batch (with a first dimension B)."""

    score: NDArray[np.float16]
    """``(16, 16)``, 0..1: where the target's centre is"""
    side: NDArray[np.float32]
    """side in pixels of the search crop that these cells cover, about its middle"""
    corners: NDArray[np.float32]
    """``(4,)``: x0, y0, x1, y1 of the box in the search crop, pixels"""
    trust: NDArray[np.float32]
    """the best score; 0 where the box misses the label, or where nothing is stored"""


def lightfc(template: Path, track: Path) -> Look:
    """The teacher from its two ONNX files (template branch; search branch), on one thread.

    Raises:
        UserError: a file is missing or is no such network, or onnxruntime is not installed.
    """
    try:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        first, second = (
            onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            for path in (template, track)
        )
    except Exception as error:  # onnxruntime raises classes of its own
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"teacher {template}, {track} cannot be opened: {reason}") from None

    def look(z: Image, x: Image) -> tuple[Array, Array, Array]:
        (features,) = first.run(None, {"image": _normalised(z)})
        score, size, offset = second.run(["score", "size", "offset"], {"image": _normalised(x), "z": features})
        return score[0, 0], size[0], offset[0]

    return look


def say(look: Look, pair: Pair) -> Said:
    """Ask the teacher about one pair.

    Its template region is twice, its search region four times the root of the target's area, both about the
    middle of the crop; what lies outside a crop is black, as it is outside a frame for LightFC. The box is
    that of the best cell under a Hann window. It must overlap the label by half, or the pair counts for nothing, as do
    negative pairs and targets under ten pixels.
    """
    size = pair.search.shape[0]
    x0, y0, x1, y1 = pair.corners
    width, height = x1 - x0 + 1, y1 - y0 + 1
    # Side of the target in a crop of ours without jitter, by the shape that it has in the search crop.
    side = pair.template.shape[0] * math.sqrt(width * height) / context_side(width, height)
    score, shape, offset = look(_middle(pair.template, 2 * side, TEMPLATE), _middle(pair.search, 4 * side, REGION))
    row, column = np.unravel_index(int((score * window()).argmax()), score.shape)
    origin = (size - 1) / 2 - 2 * side
    place = (np.array([column, row]) + offset[:, row, column]) / CELLS * 4 * side + origin
    half = shape[:, row, column] * 4 * side / 2
    corners = np.concatenate([place - half, place + half]).astype(np.float32)
    shared = float(overlap(from_corners(corners), from_corners(pair.corners)))
    agrees = pair.present and pair.side >= SMALLEST_SIDE and shared >= LEAST_OVERLAP
    trust = score[row, column] if agrees else 0.0
    return Said(score.astype(np.float16), np.array(4 * side, np.float32), corners, np.array(trust, np.float32))


def store(path: Path, look: Look, sampler: PairSampler, numbers: Iterable[int]) -> None:
    """Ask the teacher about pairs by number, and write what it says into one file.

    Args:
        path: file to write, ``*.safetensors``; a folder of such files is what training reads.
        look: the teacher.
        sampler: where the pairs come from; a run that uses the file must draw with the same options and seed.
        numbers: numbers of the pairs.

    Raises:
        UserError: the file cannot be written.
    """
    listed = list(numbers)
    said = [say(look, sampler.pair(number)) for number in listed]
    tensors = {field.name: np.stack([getattr(s, field.name) for s in said]) for field in dataclasses.fields(Said)}
    tensors["numbers"] = np.array(listed, dtype=np.int64)
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, str(temporary), metadata={"pairs": _signature(sampler.options, sampler.seed)})
        temporary.replace(path)
    except (OSError, SafetensorError) as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f"teacher maps {path} cannot be written: {error}") from None


class StoredMaps:
    """What `store` wrote into the files of a folder, by number of the pair."""

    def __init__(self, folder: Path, options: PairOptions, seed: int):
        """Read the folder.

        Raises:
            UserError: there is no file, one cannot be read, or it is of pairs drawn with other options or another seed.
        """
        files = sorted(folder.glob("*.safetensors"))
        if not files:
            raise UserError(f"folder {folder} holds no teacher maps (*.safetensors): store them first")
        parts: list[dict[str, NDArray[np.generic]]] = []
        for path in files:
            try:
                with safe_open(str(path), framework="np") as file:
                    said = (file.metadata() or {}).get("pairs")
                    parts.append({key: file.get_tensor(key) for key in file.keys()})  # noqa: SIM118 - not a dict
            except Exception as error:  # a damaged file can fail in any way
                raise UserError(f"teacher maps {path} cannot be read ({brief(error)}): store them again") from None
            if said != _signature(options, seed):
                raise UserError(f"teacher maps {path} are of other pairs: store them for this run's options and seed")
        try:
            self._fields = {field.name: np.concatenate([part[field.name] for part in parts]) for field in _FIELDS}
            numbers = np.concatenate([part["numbers"] for part in parts])
        except (KeyError, ValueError) as error:
            raise UserError(f"teacher maps in {folder} are damaged ({brief(error)}): store them again") from None
        if any(len(values) != len(numbers) for values in self._fields.values()):
            raise UserError(f"teacher maps in {folder} are damaged, of {len(numbers)} pairs: store them again")
        self._rows = {int(number): row for row, number in enumerate(numbers)}

    def __len__(self) -> int:
        return len(self._rows)

    def get(self, number: int) -> Said:
        """What is stored of a pair; of others, nothing to trust."""
        row = self._rows.get(number)
        if row is None:
            return _NOTHING
        return Said(**{name: values[row] for name, values in self._fields.items()})


def on_cells(score: Tensor, side: Tensor, search_size: int, cells: int) -> Tensor:
    """The teacher's scores at the cells of our map, bilinear between its cells, 0 outside of its region.

    Args:
        score: ``(B, 16, 16)``.
        side: ``(B,)``: pixels of the search crop that these cover, about its middle.
        search_size: side of the search crop in pixels.
        cells: side N of our score map.

    Returns:
        ``(B, N, N)``.
    """
    grid = cell_grid(search_size, cells, score.device) - (search_size - 1) / 2
    # `grid_sample` counts from -1 to 1 over the whole region, and has values in the middle of their cells. LightFC's
    # offsets lie in -0.5..0.5, so that its cells stand for the places at their upper left corners.
    places = grid[None] / (side[:, None, None, None] / 2) + 1 / CELLS
    return F.grid_sample(score[:, None].float(), places, align_corners=False)[:, 0]


def stored_loss(maps: Maps, wanted: Tensor, corners: Tensor, trust: Tensor, positive: Tensor, size: int) -> Tensor:
    """How far a network is from a stored teacher, averaged over pairs by the teacher's trust.

    Place: Kullback-Leibler divergence between the teacher's squared map and the network's scores (class times
    centre-ness), each divided by its sum. Box: -log overlap with the teacher's, over the
    cells inside the label, by the teacher's map there.

    Args:
        maps: class and centre-ness logits ``(B, N, N)`` and distances ``(B, N, N, 4)``, as of `SiamFCpp.maps`.
        wanted: ``(B, N, N)``: the teacher's scores, see `on_cells`.
        corners: ``(B, 4)``: its boxes in the search crop.
        trust: ``(B,)``, see `Said`.
        positive: ``(B, N, N)`` bool: cells inside the labelled box.
        size: side of the search crop in pixels.
    """
    logits = (F.logsigmoid(maps[0]) + F.logsigmoid(maps[1])).flatten(1)
    # Squared, the faint background of many cells weighs less than the peak.
    share = wanted.flatten(1).square().clamp(min=1e-6)
    share = share / share.sum(dim=1, keepdim=True)
    place = (share * (share.log() - F.log_softmax(logits, dim=1))).sum(dim=1)
    grid = cell_grid(size, wanted.shape[1], wanted.device)
    distances = torch.cat([grid - corners[:, None, None, :2], corners[:, None, None, 2:] - grid], dim=-1).clamp(min=0.5)
    weight = wanted * positive
    box = -torch.log(iou(maps[2], distances).clamp(min=1e-6)) * weight
    box = box.sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp(min=1e-6)
    return ((place + box) * trust).sum() / trust.sum().clamp(min=1e-6)


_FIELDS = dataclasses.fields(Said)
_NOTHING = Said(
    np.zeros((CELLS, CELLS), np.float16), np.ones((), np.float32), np.zeros(4, np.float32), np.zeros((), np.float32)
)


def _signature(options: PairOptions, seed: int) -> str:
    return json.dumps({**dataclasses.asdict(options), "seed": seed}, sort_keys=True)


def window() -> NDArray[np.float64]:
    """The Hann window ``(16, 16)`` under which LightFC chooses its cell."""
    line = 0.5 * (1 - np.cos(2 * np.pi / (CELLS + 1) * np.arange(1, CELLS + 1)))
    return np.outer(line, line)


def _middle(crop: Image, side: float, size: int) -> Image:
    """Return the square of N pixels about a crop's middle, resized; black outside."""
    scale = side / size
    start = (crop.shape[0] - 1) / 2 - (size - 1) / 2 * scale
    to_crop = np.array([[scale, 0, start], [0, scale, start]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(crop, to_crop, (size, size), flags=flags), dtype=np.uint8)


def _normalised(image: Image) -> Array:
    return np.ascontiguousarray(((image[..., ::-1] - _MEAN) / _STD).transpose(2, 0, 1)[None], dtype=np.float32)
