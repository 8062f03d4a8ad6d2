"""What a model file says about itself: widths, crop sizes, tracking constants, calibration, provenance.

This is the JSON in the metadata of a checkpoint, so it lives below both the network and the tracker and imports
neither.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from psiamfcpp.errors import UserError

FORMAT = "psiamfcpp-model/1"
TEMPLATE_SIZE = 127
STRIDE = 8
# What JSON may hold for a field, by its annotation.
_NUMBERS: dict[Any, Any] = {"int": int, "float": (int, float)}

# The 13 prunable groups with the widths of SiamFC++ (AlexNet). Neck groups tie the template and the search layer,
# since the depth-wise correlation multiplies them channel by channel.
FULL_WIDTHS: dict[str, int] = {
    "backbone.conv1": 96,
    "backbone.conv2": 256,
    "backbone.conv3": 384,
    "backbone.conv4": 384,
    "backbone.conv5": 256,
    "neck.cls": 256,
    "neck.reg": 256,
    "head.cls1": 256,
    "head.cls2": 256,
    "head.cls3": 256,
    "head.reg1": 256,
    "head.reg2": 256,
    "head.reg3": 256,
}


@dataclass(frozen=True)
class TrackingConstants:
    """Constants of the tracking procedure; the defaults are those of SiamFC++'s authors, for every benchmark."""

    test_lr: float = 0.5249642198880932
    """rate at which the size follows the estimate, before the factors penalty and score"""
    window_influence: float = 0.23153228172839774
    """weight of the cosine window against the penalised score"""
    penalty_k: float = 0.05413758904760692
    """strength of the penalty on a change of size or shape"""


@dataclass(frozen=True)
class Calibration:
    """How a score map becomes a confidence, and a confidence a state (docs/confidence.md).

    The confidence is ``sigmoid(bias + score_weight * logit(peak) + contrast_weight * log(peak / rest))``: the
    estimated probability that the target is where the peak says, fitted by `psiamfcpp calibrate`.
    """

    bias: float = 0.0
    score_weight: float = 1.0
    contrast_weight: float = 0.0
    unsure_below: float = 0.5
    """confidence under which the size is not updated"""
    lost_below: float = 0.2
    """confidence under which a frame is doubted; a run of such frames means lost"""
    regain_above: float = 0.8
    """confidence that takes a lost target up again elsewhere than where it was lost"""


@dataclass(frozen=True)
class ModelSpec:
    """A model's description, as stored in its file."""

    widths: dict[str, int] = field(default_factory=lambda: dict(FULL_WIDTHS))
    template_size: int = TEMPLATE_SIZE
    search_size: int = 303
    constants: TrackingConstants = TrackingConstants()
    calibration: Calibration = Calibration()
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_widths(self.widths)
        score_size(self.search_size, self.template_size)

    def to_json(self) -> str:
        """The spec as one JSON object, keys sorted, with its format name."""
        return json.dumps({"format": FORMAT, **dataclasses.asdict(self)}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> ModelSpec:
        """Read what `to_json` wrote.

        Raises:
            UserError: not JSON, another format, an unknown key (its nearest name is given) or a value out of range.
        """
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise UserError(f"model description is not JSON ({error}): the file is damaged or foreign") from None
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            raise UserError(f"model description is not {FORMAT}: the file comes from another program or version")
        constants = _build(TrackingConstants, data.pop("constants", {}))
        calibration = _build(Calibration, data.pop("calibration", {}))
        return _build(cls, {**data, "constants": constants, "calibration": calibration})


def feature_size(side: int) -> int:
    """Side of the backbone's map for a crop of ``side`` pixels (design of AlexNet without padding, pools round up)."""
    conv1 = (side - 11) // 2 + 1
    pool1 = math.ceil((conv1 - 3) / 2) + 1
    pool2 = math.ceil((pool1 - 4 - 3) / 2) + 1
    return pool2 - 6


def score_size(search_size: int, template_size: int = TEMPLATE_SIZE) -> int:
    """Side of the score map: 17 for a search crop of 303 pixels and a template of 127.

    Raises:
        UserError: the sizes leave no map, or its cells would not lie symmetrically about the crop's centre.
    """
    if (search_size - template_size) % STRIDE or search_size % 2 == 0:
        raise UserError(f"search size {search_size} is not {template_size} plus a multiple of {STRIDE}: try 239 or 303")
    cells = (feature_size(search_size) - 2) - (feature_size(template_size) - 2) + 1 - 6
    if cells < 3:
        raise UserError(f"search size {search_size} leaves a score map of {cells} cells: try 239 or 303")
    return cells


def first_cell(search_size: int, template_size: int = TEMPLATE_SIZE) -> int:
    """Pixel of the search crop, in x and in y, at which cell 0 of the score map stands: 87 for 303."""
    return (search_size - 1 - (score_size(search_size, template_size) - 1) * STRIDE) // 2


def _check_widths(widths: Mapping[str, int]) -> None:
    missing, extra = set(FULL_WIDTHS) - set(widths), set(widths) - set(FULL_WIDTHS)
    if missing or extra:
        raise UserError(f"widths need the 13 groups; missing {sorted(missing)}, unknown {sorted(extra)}")
    for name, width in widths.items():
        if not isinstance(width, int) or width < 1:
            raise UserError(f"width of {name} is {width!r}: it must be a whole number above 0")


def _build(cls: type[Any], data: Any) -> Any:
    """A dataclass from a JSON object; an unknown key is an error that names the nearest known one."""
    if not isinstance(data, dict):
        raise UserError(f"{cls.__name__} in the model description is not an object: the file is damaged")
    known = {f.name: _NUMBERS.get(f.type) for f in dataclasses.fields(cls)}
    for key, value in data.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f": did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
            raise UserError(f"unknown key {key!r} in {cls.__name__}{hint}")
        kind = known[key]
        if kind and not (isinstance(value, kind) and math.isfinite(value)):
            raise UserError(f"{key} in {cls.__name__} is {value!r}, which is no such number: the file is damaged")
    try:
        return cls(**data)
    except TypeError as error:
        raise UserError(f"{cls.__name__} in the model description is damaged: {error}") from None
