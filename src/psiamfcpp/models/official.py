"""Official SiamFC++ checkpoints: a pickled state dict under the original names, read without running code."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from psiamfcpp.errors import UserError, brief
from psiamfcpp.files import check_file
from psiamfcpp.models.checkpoint import fit
from psiamfcpp.models.network import SiamFCpp

_RENAMES = (
    (r"^basemodel\.", "backbone."),
    (r"^c_z_k\.", "neck.cls_template."),
    (r"^c_x\.", "neck.cls_search."),
    (r"^r_z_k\.", "neck.reg_template."),
    (r"^r_x\.", "neck.reg_search."),
    (r"^head\.cls_p5_conv(\d)\.", r"head.cls\1."),
    (r"^head\.bbox_p5_conv(\d)\.", r"head.reg\1."),
    (r"^head\.cls_score_p5\.", "head.cls_score."),
    (r"^head\.ctr_score_p5\.", "head.centerness."),
    (r"^head\.bbox_offsets_p5\.", "head.reg_offsets."),
)


def import_official(path: Path) -> SiamFCpp:
    """The unpruned network with the weights of an official checkpoint.

    Args:
        path: a ``torch.save`` file: a state dict in the official naming, bare or under ``model_state_dict``, with or
            without the prefix ``module.``.

    Raises:
        UserError: no such file, not such a checkpoint, or weights missing, extra or of another shape (they are named).
    """
    check_file(path, "checkpoint", "give the official .pkl or .pth file")
    try:
        with warnings.catch_warnings():
            # torch warns of pickle protocols that it then reads none the less.
            warnings.simplefilter("ignore")
            loaded: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can fail in any way
        reason = brief(str(error).split(". ")[0] or type(error).__name__)
        raise UserError(f"checkpoint {path} cannot be read as plain weights: {reason}") from None
    state = loaded.get("model_state_dict", loaded) if isinstance(loaded, dict) else None
    if (
        not isinstance(state, dict)
        or not state
        or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items())
    ):
        raise UserError(f"checkpoint {path} holds no state dict, neither bare nor under 'model_state_dict'")
    model = SiamFCpp()
    weights = {_our_name(key): value for key, value in state.items()}
    # The original keeps its two scalars as one-element vectors in some versions.
    for key in ("head.si", "head.bi"):
        if key in weights and weights[key].numel() == 1:
            weights[key] = weights[key].reshape(())
    fit(model, weights, str(path))
    model.spec.provenance["imported_from"] = path.name
    return model.eval()


def _our_name(key: str) -> str:
    key = key.removeprefix("module.")
    for pattern, replacement in _RENAMES:
        key, count = re.subn(pattern, replacement, key)
        if count:
            break
    return key
