"""Options of the SiamFC++ tracker, spelled once for Python and the command line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackerOptions:
    """How our models run. None of it but ``search_size``, ``plain`` and the device changes what is computed."""

    engine: str | None = None
    """what runs the network: onnx, openvino or torch; by default onnx for graphs and torch for a checkpoint"""
    device: str = "cpu"
    """cpu, cuda or cuda:N"""
    threads: int | None = None
    """threads of the tracker; by default all cores"""
    search_size: int | None = None
    """side of the search crop, pixels; by default the model's own. 239 costs 29 percent less than 271"""
    plain: bool = False
    """follow the published procedure exactly, without states and re-detection, to compare with published figures"""
