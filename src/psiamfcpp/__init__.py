"""Real-time UAV tracking on a CPU: SiamFC++ (AlexNet) compressed by rank-based filter pruning."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from psiamfcpp.version import __version__

if TYPE_CHECKING:
    from psiamfcpp.errors import UserError
    from psiamfcpp.recipes.follow import follow
    from psiamfcpp.trackers import TargetPool, Track, TrackerOptions, open_tracker
    from psiamfcpp.trackers.siamfcpp import Tracker
    from psiamfcpp.video.span import Span

__all__ = [
    "Span",
    "TargetPool",
    "Track",
    "Tracker",
    "TrackerOptions",
    "UserError",
    "__version__",
    "follow",
    "open_tracker",
]

# Imported when first asked for: a command must answer Ctrl-C before that second is over.
_MODULES = {
    "UserError": "psiamfcpp.errors",
    "follow": "psiamfcpp.recipes.follow",
    "Span": "psiamfcpp.video.span",
    "TargetPool": "psiamfcpp.trackers",
    "Track": "psiamfcpp.trackers",
    "TrackerOptions": "psiamfcpp.trackers",
    "open_tracker": "psiamfcpp.trackers",
    "Tracker": "psiamfcpp.trackers.siamfcpp",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
