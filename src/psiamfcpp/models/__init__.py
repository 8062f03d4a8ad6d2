"""The torch network, its checkpoints and the ways to start it; `arch` describes networks without torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from psiamfcpp.models.checkpoint import build, load, save
    from psiamfcpp.models.network import Network, SiamFCpp

__all__ = ["Network", "SiamFCpp", "build", "load", "save"]


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` when it is first asked for: a spec needs the tables alone, and torch is slow."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from psiamfcpp.models import checkpoint, network

    return getattr(checkpoint if name in ("build", "load", "save") else network, name)
