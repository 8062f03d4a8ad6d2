"""What a model file says about itself: architecture, widths, crop sizes, constants, calibration, provenance.

This is the JSON in the metadata of a checkpoint, so it lives below both the network and the tracker and imports
neither; of `models` it reads the tables of layers alone.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import parse_json
from psiamfcpp.models.arch import DEFAULT, Architecture, architecture

FORMAT = "psiamfcpp-model/1"
# What a spec takes from its architecture unless it is given.
_OWN: Any = None
# What JSON may hold for a field, by its annotation.
_KINDS: dict[Any, Any] = {
    "int": int,
    "float": (int, float),
    "str": str,
    "dict[str, int]": dict,
    "dict[str, Any]": dict,
}
# Far above any network of use: larger ones are damaged files, for which no memory would do.
_MOST_FILTERS = 2**14
_MOST_PIXELS = 2**11
# Entries of the provenance to which each step appends.
_STEPS = ("training", "pruning")


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
    """Turn a score map into a confidence, and the confidence into a state (docs/confidence.md).

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
    """confidence that re-acquires a lost target elsewhere than where it was lost"""


@dataclass(frozen=True)
class ModelSpec:
    """A model's description, as stored in its file."""

    widths: dict[str, int] = _OWN
    """of each group; by default those of the architecture"""
    template_size: int = _OWN
    """side of the template crop, pixels; by default that of the architecture, as is the next"""
    search_size: int = _OWN
    constants: TrackingConstants = TrackingConstants()
    calibration: Calibration | None = Calibration()
    """None where none was fitted: then the published procedure is followed, and no state is stated"""
    provenance: dict[str, Any] = field(default_factory=dict)
    architecture: str = DEFAULT
    """a key of `psiamfcpp.models.arch.ARCHITECTURES`"""

    def __post_init__(self) -> None:
        arch = self.arch
        own = {"widths": dict(arch.groups), "template_size": arch.template_size, "search_size": arch.search_size}
        for name, value in own.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        _check_widths(self.widths, arch)
        if self.template_size != arch.template_size:
            raise UserError(f"template size is {self.template_size}: {self.architecture} has {arch.template_size}")
        if self.search_size > _MOST_PIXELS:
            raise UserError(f"search size {self.search_size} is too large: at most {_MOST_PIXELS} pixels")
        arch.score_size(self.search_size)
        wrong = next((key for key in _STEPS if not isinstance(self.provenance.get(key, []), list)), None)
        if wrong is not None:
            raise UserError(f"{wrong} in the provenance is no list of steps: the file is damaged")

    @property
    def arch(self) -> Architecture:
        """The table of the architecture."""
        return architecture(self.architecture)

    def to_json(self) -> str:
        """Return the spec as one JSON object, keys sorted, with its format name."""
        data = {"format": FORMAT, **dataclasses.asdict(self)}
        if self.architecture == DEFAULT:
            # Not stated, so that version 0.1 reads these files as well.
            del data["architecture"]
        return json.dumps(data, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> ModelSpec:
        """Read what `to_json` wrote.

        Raises:
            UserError: not JSON, another format, an unknown key (its nearest name is given) or a value out of range.
        """
        data = parse_json(text, "model description")
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            raise UserError(f"model description is not {FORMAT}: the file comes from another program or version")
        constants = _build(TrackingConstants, data.pop("constants", {}))
        calibration = data.pop("calibration", {})
        calibration = None if calibration is None else _build(Calibration, calibration)
        return _build(cls, {**data, "constants": constants, "calibration": calibration})


def _check_widths(widths: Mapping[str, int], arch: Architecture) -> None:
    missing, extra = set(arch.groups) - set(widths), set(widths) - set(arch.groups)
    if missing or extra:
        raise UserError(
            f"widths need the {len(arch.groups)} groups; missing {brief(sorted(missing))}, "
            f"unknown {brief(sorted(extra))}"
        )
    for name, width in widths.items():
        if not isinstance(width, int) or isinstance(width, bool) or not 1 <= width <= _MOST_FILTERS:
            raise UserError(f"width of {name} is {width!r}: it must be a whole number from 1 to {_MOST_FILTERS}")


def _build(cls: type[Any], data: Any) -> Any:
    """A dataclass from a JSON object; an unknown key is an error that names the nearest known one."""
    if not isinstance(data, dict):
        raise UserError(f"{cls.__name__} in the model description is not an object: the file is damaged")
    known = {f.name: _KINDS.get(f.type) for f in dataclasses.fields(cls)}
    for key, value in data.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f": did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
            raise UserError(f"unknown key {brief(repr(key))} in {cls.__name__}{hint}")
        kind = known[key]
        if kind and not _is_of(value, kind):
            raise UserError(
                f"{key} in {cls.__name__} is {brief(repr(value))}, which is no such value: the file is damaged"
            )
    return cls(**data)


def _is_of(value: Any, kind: Any) -> bool:
    """Whether a value that JSON held is of a kind; True and False are no numbers, nor is NaN or what is infinite."""
    if isinstance(value, (int, float)):
        return isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, kind)
