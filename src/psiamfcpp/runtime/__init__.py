"""Engines that run a model, all behind the same two calls."""

from psiamfcpp.runtime.engine import ENGINES, Engine, open_engine

__all__ = ["ENGINES", "Engine", "open_engine"]
