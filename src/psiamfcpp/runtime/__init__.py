"""Engines that run a model, all behind the same calls."""

from psiamfcpp.machine import usable_cores
from psiamfcpp.runtime.engine import Engine
from psiamfcpp.runtime.opening import ENGINES, open_engine, runs

__all__ = ["ENGINES", "Engine", "open_engine", "runs", "usable_cores"]
