"""Trackers in processes of their own, and ours for the tools of others, over the TraX protocol."""

from psiamfcpp.trackers.trax.adapter import adapter_files, describe_adapters, open_adapter
from psiamfcpp.trackers.trax.client import TraxTracker, open_trax, trax_files, trax_name
from psiamfcpp.trackers.trax.server import serve_trax

__all__ = [
    "TraxTracker",
    "adapter_files",
    "describe_adapters",
    "open_adapter",
    "open_trax",
    "serve_trax",
    "trax_files",
    "trax_name",
]
