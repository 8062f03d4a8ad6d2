"""Real-time UAV tracking on a CPU: SiamFC++ (AlexNet) compressed by rank-based filter pruning."""

from psiamfcpp.errors import UserError
from psiamfcpp.recipes.follow import follow
from psiamfcpp.trackers import TargetPool, Track, TrackerOptions, open_tracker
from psiamfcpp.trackers.siamfcpp import Tracker
from psiamfcpp.version import __version__
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
