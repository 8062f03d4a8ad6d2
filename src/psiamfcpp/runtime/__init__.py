"""Engines that run a model, all behind the same calls."""

from psiamfcpp.runtime.engine import ENGINES, Engine, open_engine, usable_cores

__all__ = ["ENGINES", "Engine", "open_engine", "usable_cores"]
