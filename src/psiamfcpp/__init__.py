"""Real-time UAV tracking on a CPU: SiamFC++ (AlexNet) compressed by rank-based filter pruning."""

from psiamfcpp.errors import UserError
from psiamfcpp.tracking import TargetPool, Track, Tracker

__version__ = "0.1.0"
__all__ = ["TargetPool", "Track", "Tracker", "UserError"]
