"""D3S (Lukezic et al., "D3S - A Discriminative Single Shot Segmentation Tracker", CVPR 2020) as a TraX worker."""

import importlib
from typing import Any, List

from adapting import Setup, leave_out, main

FACTS = {
    "name": "D3S",
    "repository": "https://github.com/alanlukezic/d3s",
    "commit": "4a83fa6dde8875db15cce051e1b8e4d11a2e6d63",
    "licence": "GPL-3.0 of PyTracking, from which it is derived; none stated of its own",
    "weights": "SegmNet.pth.tar of the repository's README",
    "modules": ["torch", "torchvision", "cv2", "matplotlib"],
    # pytracking/tracker/base/basetracker.py reads RGB; pytracking/tracker/segm/segm.py takes 1 from x and y of a
    # rectangle, and adds 1 to what it returns
    "colour": "rgb",
    "origin": 1,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "option backbone: ResNet-50 of ImageNet (resnet50-19c8e357.pth), which the tracker would fetch itself",
}


class _Tracker:
    def __init__(self, make: Any) -> None:
        self._make = make

    def init(self, image: Any, box: List[float]) -> None:
        self._tracker = self._make()
        self._tracker.sequence_name = self._tracker.frame_name = ""
        self._tracker.initialize(image, list(box))

    def update(self, image: Any) -> Any:
        return self._tracker.track(image)


def build(setup: Setup) -> Any:
    """Return what makes the tracker of pytracking/vot_wrapper.py, with axis-aligned boxes."""
    import cv2
    import matplotlib

    # the trackers' base class asks for a window, of which nothing is shown
    matplotlib.use("Agg")
    matplotlib.use = lambda *args, **kwargs: None
    # pytracking/bbox_fit.py reads the major version from the fifth character from the end
    cv2.__version__ = "4.1.0"
    # of datasets
    leave_out("pandas")
    import ltr.models.backbone.resnet as resnet
    from pytracking import TensorList
    from pytracking.features import extractor
    from pytracking.parameter.segm import default_params
    from pytracking.tracker.segm import segm

    extractor.MultiResolutionExtractor.stride = _stride
    answer = TensorList.__getattr__
    TensorList.__getattr__ = lambda self, name: _refuse(name) if name.startswith("__") else answer(self, name)
    functional = importlib.import_module("torch.nn.functional")
    pad = functional.pad
    # whole numbers as floats, which torch refuses since version 1.5
    functional.pad = lambda image, sizes, *args, **kwargs: pad(image, [int(size) for size in sizes], *args, **kwargs)
    _replace_downloads(resnet, setup)
    if not setup.weights:
        segm.load_network = _random_network

    def make() -> Any:
        params = default_params.parameters()
        params.debug, params.visualization = 0, False
        # without use_gpu the published code lacks a variable; without a GPU its .cuda() stays on the CPU
        params.use_gpu, params.device = True, setup.device
        params.segm_net_path = setup.weights
        return segm.Segm(params)

    return _Tracker(make)


def _refuse(name: str) -> Any:
    # lists of tensors claim to have every attribute, so that newer versions of torch take them for tensors
    raise AttributeError(name)


def _stride(self: Any) -> Any:
    import torch

    # the original gives torch.Tensor a list of its own kind, which torch takes for a storage since version 1.13
    return torch.Tensor([s for kind in self.features if self._return_feature(kind) for s in kind.stride()])


def _replace_downloads(resnet: Any, setup: Setup) -> None:
    """Take the backbone of the filter from the user's file, or random weights with random weights."""
    import torch

    resnet50 = resnet.resnet50
    file = setup.options.get("backbone", "")
    if setup.weights and not file:
        raise ValueError("D3S needs option backbone=FILE as well: ResNet-50 of ImageNet, resnet50-19c8e357.pth")

    def local(*args: Any, pretrained: bool = False, **kwargs: Any) -> Any:
        net = resnet50(*args, pretrained=False, **kwargs)
        if pretrained and file:
            net.load_state_dict(torch.load(file, map_location="cpu"))
        return net

    resnet.resnet50 = local


def _random_network(*args: Any, **kwargs: Any) -> Any:
    from ltr.models.segm.segm import segm_resnet50

    # ltr/train_settings/segm/segm_default.py: with a distance map there is one channel more
    return segm_resnet50(backbone_pretrained=False, topk_pos=3, topk_neg=3, mixer_channels=3), None


if __name__ == "__main__":
    main(FACTS, build)
