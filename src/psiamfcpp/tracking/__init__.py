"""Frame in, box out."""

from psiamfcpp.tracking.tracker import Track, Tracker

__all__ = ["Track", "Tracker"]
