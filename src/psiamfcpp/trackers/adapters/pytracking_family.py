"""What the trackers built on PyTracking (github.com/visionml/pytracking) have in common."""

import importlib
import importlib.util
import sys
import types
from typing import Any, Callable

import precise_roi
from trax_worker import PytrackingStyle, Setup

# Modules of the checkout that its packages import by themselves: they run benchmarks and cameras, and need much else.
_LEFT_OUT = ("pytracking.run_tracker", "pytracking.run_webcam", "pytracking.evaluation.tracker")
# Packages that other trackers and datasets of the checkout need, by the names under which they are imported.
_UNUSED = ("jpeg4py", "timm", "timm.models", "timm.models.layers")


class _Absent(types.ModuleType):
    """A module in which every name is a class that nothing is made of."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        # a package, so that modules inside of it may be named
        self.__path__ = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def build_pytracking(setup: Setup, tracker: str, parameters: str, random_network: Callable[[], Any]) -> Any:
    """Return what makes a tracker for each target, all with one network.

    Args:
        setup: of the adapter.
        tracker: module of ``pytracking.tracker``.
        parameters: module of ``pytracking.parameter``.
        random_network: makes a network with random weights, for a setup without a weights file.
    """
    unused = [name for name in _UNUSED if importlib.util.find_spec(name.split(".")[0]) is None]
    for name in (*_LEFT_OUT, *unused):
        sys.modules[name] = _Absent(name)
    precise_roi.offer("ltr.external.PreciseRoIPooling.pytorch.prroi_pool", setup.device)
    params = importlib.import_module("pytracking.parameter." + parameters).parameters()
    make = importlib.import_module("pytracking.tracker." + tracker).get_tracker_class()
    params.use_gpu = params.net.use_gpu = setup.device == "cuda"
    params.net.net_path = setup.weights
    if setup.weights:
        params.net.initialize()
    else:
        params.net.net = random_network().eval()
        if params.use_gpu:
            params.net.cuda()

    def started() -> Any:
        made = make(params)
        # the network is loaded once, not for every target
        made.features_initialized = True
        return made

    return PytrackingStyle(started)
