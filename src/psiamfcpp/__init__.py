"""Real-time UAV tracking on a CPU: SiamFC++ (AlexNet) compressed by rank-based filter pruning."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from psiamfcpp.version import __version__

# Otherwise onnxruntime sends telemetry, and writes an identifier to the home folder. Whoever sets it decides.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from psiamfcpp.errors import UserError
    from psiamfcpp.recipes.bench import bench
    from psiamfcpp.recipes.calibrate import calibrate
    from psiamfcpp.recipes.evaluate import evaluate
    from psiamfcpp.recipes.export import export as export_graphs
    from psiamfcpp.recipes.follow import follow
    from psiamfcpp.recipes.importing import import_model
    from psiamfcpp.recipes.info import info
    from psiamfcpp.recipes.plan import Timing, plan
    from psiamfcpp.recipes.prune import prune
    from psiamfcpp.recipes.rank import rank
    from psiamfcpp.recipes.report import report as write_report
    from psiamfcpp.recipes.reproduce import reproduce
    from psiamfcpp.recipes.score import score
    from psiamfcpp.recipes.sensitivity import sensitivity
    from psiamfcpp.recipes.train import train
    from psiamfcpp.spec import TrackingConstants
    from psiamfcpp.trackers import TargetPool, Track, TrackerOptions, open_tracker
    from psiamfcpp.trackers.listing import list_trackers
    from psiamfcpp.trackers.siamfcpp import Tracker
    from psiamfcpp.training.options import RunOptions, TrainOptions
    from psiamfcpp.video.span import Span

__all__ = [
    "RunOptions",
    "Span",
    "TargetPool",
    "Timing",
    "Track",
    "Tracker",
    "TrackerOptions",
    "TrackingConstants",
    "TrainOptions",
    "UserError",
    "__version__",
    "bench",
    "calibrate",
    "evaluate",
    "export_graphs",
    "follow",
    "import_model",
    "info",
    "list_trackers",
    "open_tracker",
    "plan",
    "prune",
    "rank",
    "reproduce",
    "score",
    "sensitivity",
    "train",
    "write_report",
]

# Where names come from, ``module`` or ``module:name``; `export` and `report` are folders already. They are imported
# when first asked for: importing the package must be quick, a command must answer Ctrl-C at once.
_PLACES = {
    "RunOptions": "psiamfcpp.training.options",
    "Span": "psiamfcpp.video.span",
    "TargetPool": "psiamfcpp.trackers",
    "Timing": "psiamfcpp.recipes.plan",
    "Track": "psiamfcpp.trackers",
    "Tracker": "psiamfcpp.trackers.siamfcpp",
    "TrackerOptions": "psiamfcpp.trackers",
    "TrackingConstants": "psiamfcpp.spec",
    "TrainOptions": "psiamfcpp.training.options",
    "UserError": "psiamfcpp.errors",
    "bench": "psiamfcpp.recipes.bench",
    "calibrate": "psiamfcpp.recipes.calibrate",
    "evaluate": "psiamfcpp.recipes.evaluate",
    "export_graphs": "psiamfcpp.recipes.export:export",
    "follow": "psiamfcpp.recipes.follow",
    "import_model": "psiamfcpp.recipes.importing",
    "info": "psiamfcpp.recipes.info",
    "list_trackers": "psiamfcpp.trackers.listing",
    "open_tracker": "psiamfcpp.trackers",
    "plan": "psiamfcpp.recipes.plan",
    "prune": "psiamfcpp.recipes.prune",
    "rank": "psiamfcpp.recipes.rank",
    "reproduce": "psiamfcpp.recipes.reproduce",
    "score": "psiamfcpp.recipes.score",
    "sensitivity": "psiamfcpp.recipes.sensitivity",
    "train": "psiamfcpp.recipes.train",
    "write_report": "psiamfcpp.recipes.report:report",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own = _PLACES[name].partition(":")
    found = globals()[name] = getattr(importlib.import_module(module), own or name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
