"""Trackers: one contract, and one function that opens any of them."""

from psiamfcpp.trackers.contract import STATES, State, Track, Tracker
from psiamfcpp.trackers.opening import TrackerChoice, choose, open_tracker
from psiamfcpp.trackers.pool import TargetPool
from psiamfcpp.trackers.siamfcpp import TrackerOptions

__all__ = [
    "STATES",
    "State",
    "TargetPool",
    "Track",
    "Tracker",
    "TrackerChoice",
    "TrackerOptions",
    "choose",
    "open_tracker",
]
