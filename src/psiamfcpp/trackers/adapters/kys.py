"""KYS (Bhat et al., "Know Your Surroundings", ECCV 2020) as a TraX worker."""

from typing import Any

import correlation
from adapting import Setup, main
from pytracking_family import build_pytracking

FACTS = {
    "name": "KYS",
    "repository": "https://github.com/visionml/pytracking",
    "commit": "7eb9e74bd3d40e29dbcec444902237da13de247b",
    "licence": "GPL-3.0",
    "weights": "kys.pth of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "matplotlib"],
    # pytracking/evaluation/tracker.py reads RGB and passes 0-based boxes
    "colour": "rgb",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "parameter/kys/default.py; draws augmentations and start boxes at random, hence the seeds",
}


def build(setup: Setup) -> Any:
    """Return what makes the tracker with the published parameters."""
    correlation.offer()
    return build_pytracking(setup, "kys", "kys.default", _random_network)


def _random_network() -> Any:
    from ltr.models.tracking.kysnet import kysnet_res50

    # ltr/train_settings/kys/kys.py
    return kysnet_res50(
        optim_iter=3, cv_kernel_size=3, cv_max_displacement=9, cv_stride=1, init_gauss_sigma=0.9, detach_length=0,
        train_feature_extractor=False, train_iounet=False, state_dim=8, representation_predictor_dims=(16,),
        conf_measure="entropy", dimp_thresh=0.05, backbone_pretrained=False,
    )  # fmt: skip


if __name__ == "__main__":
    main(FACTS, build)
