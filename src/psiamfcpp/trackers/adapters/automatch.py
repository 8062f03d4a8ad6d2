"""AutoMatch (Zhang et al., "Learn to Match", ICCV 2021) as a TraX worker."""

import sys
from pathlib import Path
from typing import Any, List

import numpy as np
from adapting import Setup, leave_out, main

FACTS = {
    "name": "AutoMatch",
    "repository": "https://github.com/JudasDie/SOTS",
    "commit": "3a6af0d17dd80a8d130d1c3f51cf496a89441694",
    "licence": "none stated",
    "weights": "AutoMatch.pth of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "yaml", "easydict", "shapely", "loguru"],
    # tracking/test_sot.py hands on what OpenCV reads; cxy_wh_2_rect says 0-index
    "colour": "bgr",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "option dataset: whose hyper-parameters of experiments/AutoMatch.yaml, by default UAV123",
}


class _Tracker:
    def __init__(self, tracker: Any, net: Any) -> None:
        self._tracker, self._net = tracker, net

    def init(self, image: Any, box: List[float]) -> None:
        x, y, w, h = box
        place, size = np.array([x + w / 2, y + h / 2]), np.array([w, h])
        self._tracker.init({"image": image, "pos": place, "sz": size, "model": self._net})

    def update(self, image: Any) -> Any:
        import torch
        from utils.box_helper import cxy_wh_2_rect

        with torch.no_grad():
            state = self._tracker.track(image)
        return cxy_wh_2_rect(state["pos"], state["sz"]), state["score"]


def build(setup: Setup) -> Any:
    """Return the tracker of tracking/test_sot.py."""
    sys.path.insert(0, str(Path(setup.checkout) / "lib"))
    # of training
    leave_out("wandb")
    import utils.model_helper as loader
    import utils.read_file as reader
    import utils.sot_builder as builder
    from easydict import EasyDict
    from tracker.sot_tracker import SiamTracker

    config = EasyDict(reader.load_yaml("experiments/AutoMatch.yaml"))
    config.TEST.DATA = setup.options.get("dataset", "UAV123")
    net = builder.Siamese_builder(config).build()
    if setup.weights:
        net = loader.load_pretrain(net, setup.weights, addhead=True, print_unuse=False)
    return _Tracker(SiamTracker(config), net.eval().cuda())


if __name__ == "__main__":
    main(FACTS, build)
