"""TransT (Chen et al., "Transformer Tracking", CVPR 2021) as a TraX worker."""

import argparse
from typing import Any

from adapting import PytrackingStyle, Setup, main

FACTS = {
    "name": "TransT",
    "repository": "https://github.com/chenxin-dlut/TransT",
    "commit": "2793ef31f83222280b4c421f7ae15a61ba7871f1",
    "licence": "GPL-3.0",
    "weights": "transt.pth of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "scipy"],
    # pysot_toolkit/test.py converts what OpenCV reads to RGB and passes 0-based boxes
    "colour": "rgb",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "the published window penalty of 0.49",
}


def build(setup: Setup) -> Any:
    """Return the tracker of pysot_toolkit/test.py."""
    import torchvision

    # util/misc.py takes 0.10 and later for 0.1, and imports what only versions below 0.7 have
    torchvision.__version__ = "0.9"
    import ltr.models.backbone as backbones
    from pysot_toolkit.trackers.net_wrappers import NetWithBackbone
    from pysot_toolkit.trackers.tracker import Tracker

    # the weights file has the backbone as well: that of ImageNet is not fetched first
    resnet50 = backbones.resnet50
    backbones.resnet50 = lambda *args, **kwargs: resnet50(*args, **dict(kwargs, pretrained=False))
    net = NetWithBackbone(net_path=setup.weights, use_gpu=setup.device == "cuda")
    if not setup.weights:
        net.load_network = lambda: _load_random(net, setup.device)
    tracker = Tracker(name="transt", net=net, window_penalty=0.49, exemplar_size=128, instance_size=256)
    return PytrackingStyle(tracker, score="best_score")


def _load_random(net: Any, device: str) -> None:
    from ltr.models.tracking.transt import transt_resnet50

    # ltr/train_settings/transt/transt.py
    sizes = {"hidden_dim": 256, "dropout": 0.1, "nheads": 8, "dim_feedforward": 2048, "featurefusion_layers": 4}
    net.net = transt_resnet50(argparse.Namespace(device=device, position_embedding="sine", **sizes))
    net.net.eval()


if __name__ == "__main__":
    main(FACTS, build)
