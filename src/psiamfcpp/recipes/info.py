"""Describe a model or any other tracker."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from psiamfcpp.models.cost import facts
from psiamfcpp.runtime import open_engine
from psiamfcpp.spec import ModelSpec
from psiamfcpp.trackers.opening import choose
from psiamfcpp.zoo import graph_folder, names, weights_path


def info(tracker: str | Path) -> dict[str, Any]:
    """Return what is known of a tracker, as of a model: a checkpoint or a folder of graphs.

    Args:
        tracker: as of `psiamfcpp.open_tracker`.

    Returns:
        Of a model ``architecture``, ``parameters``, ``gmacs`` of a search crop, ``widths``, ``search_size``,
        ``constants``, ``calibration`` and ``provenance``. Of another tracker ``kind`` and ``name``, with what decides
        its boxes: options, and the checksum of its files.

    Raises:
        UserError: there is no such tracker, or a file or an option is missing or wrong.
    """
    choice = choose(str(tracker))
    if choice.kind != "model":
        return {"kind": choice.kind, "name": choice.name, **choice.identity()}
    spec = _spec(choice.entry)
    return {
        "architecture": spec.architecture,
        **facts(spec),
        "search_size": spec.search_size,
        "constants": dataclasses.asdict(spec.constants),
        "calibration": dataclasses.asdict(spec.calibration) if spec.calibration else None,
        "provenance": spec.provenance,
    }


def _spec(model: str) -> ModelSpec:
    if model not in names() and graph_folder(model):
        return open_engine(model, threads=1).spec
    checkpoint = weights_path(model)  # a wrong name is refused before torch is asked for
    from psiamfcpp.models import load

    return load(checkpoint).spec
