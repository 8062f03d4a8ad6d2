"""Frame in, box out."""

from psiamfcpp.tracking.pool import TargetPool
from psiamfcpp.tracking.tracker import Track, Tracker

__all__ = ["TargetPool", "Track", "Tracker"]
