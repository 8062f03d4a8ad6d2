"""The torch network, its checkpoints and the ways to start it."""

from psiamfcpp.models.checkpoint import load, save
from psiamfcpp.models.network import SiamFCpp

__all__ = ["SiamFCpp", "load", "save"]
