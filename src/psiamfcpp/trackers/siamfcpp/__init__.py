"""The SiamFC++ tracker: the published procedure, and on top of it states and re-detection."""

from psiamfcpp.trackers.siamfcpp.options import TrackerOptions
from psiamfcpp.trackers.siamfcpp.tracker import Tracker

__all__ = ["Tracker", "TrackerOptions"]
