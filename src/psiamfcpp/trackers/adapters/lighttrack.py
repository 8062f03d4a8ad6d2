"""LightTrack-Mobile (Yan et al., "LightTrack", CVPR 2021) as a TraX worker."""

import argparse
from typing import Any, List

import numpy as np
from adapting import Setup, main

FACTS = {
    "name": "LightTrack",
    "repository": "https://github.com/researchmm/LightTrack",
    "commit": "39c426f48ee674795cdf0e00301a0b4ad0785d2a",
    "licence": "MIT",
    "weights": "snapshot/LightTrackM/LightTrackM.pth",
    "modules": ["torch", "cv2", "yaml", "shapely"],
    # tracking/test_lighttrack.py converts what OpenCV reads to RGB; cxy_wh_2_rect says 0-index
    "colour": "rgb",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "the hyper-parameters published for VOT2019, the only ones in the repository",
}
# tracking/reproduce_vot2019.sh
_PATH = "back_04502514044521042540+cls_211000022+reg_100000111_ops_32"
_STRIDE = 16


class _Tracker:
    """Holds the state that the published tracker hands from call to call."""

    def __init__(self, tracker: Any, net: Any) -> None:
        self._tracker, self._net = tracker, net

    def init(self, image: Any, box: List[float]) -> None:
        x, y, w, h = box
        self._state = self._tracker.init(image, np.array([x + w / 2, y + h / 2]), np.array([w, h]), self._net)

    def update(self, image: Any) -> Any:
        import torch
        from lib.utils.utils import cxy_wh_2_rect

        with torch.no_grad():
            self._state = self._tracker.track(self._state, image)
        return cxy_wh_2_rect(self._state["target_pos"], self._state["target_sz"])


def build(setup: Setup) -> Any:
    """Return the tracker of tracking/test_lighttrack.py, as tracking/reproduce_vot2019.sh starts it."""
    from lib.models.models import LightTrackM_Subnet
    from lib.tracker.lighttrack import Lighttrack
    from lib.utils.utils import load_pretrain

    net = LightTrackM_Subnet(_PATH, stride=_STRIDE)
    if setup.weights:
        net = load_pretrain(net, setup.weights)
    info = argparse.Namespace(arch="LightTrackM_Subnet", dataset="VOT2019", epoch_test=False, stride=_STRIDE)
    return _Tracker(Lighttrack(info, even=0), net.eval().cuda())


if __name__ == "__main__":
    main(FACTS, build)
