"""What the trackers built on PyTracking (github.com/visionml/pytracking) have in common."""

import importlib
from typing import Any, Callable

import precise_roi
from adapting import PytrackingStyle, Setup, leave_out

# They run benchmarks and cameras, read datasets, and belong to other trackers of the checkout.
_LEFT_OUT = (
    "pytracking.run_tracker", "pytracking.run_webcam", "pytracking.evaluation.tracker", "jpeg4py", "pandas", "timm",
    "timm.models", "timm.models.layers",
)  # fmt: skip


def build_pytracking(setup: Setup, tracker: str, parameters: str, random_network: Callable[[], Any]) -> Any:
    """Return what makes a tracker for each target, all with one network.

    Args:
        setup: of the adapter.
        tracker: module of ``pytracking.tracker``.
        parameters: module of ``pytracking.parameter``.
        random_network: makes a network with random weights, for a setup without a weights file.
    """
    leave_out(*_LEFT_OUT)
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
