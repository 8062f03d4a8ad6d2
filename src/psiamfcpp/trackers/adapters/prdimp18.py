"""PrDiMP-18 (Danelljan et al., "Probabilistic Regression for Visual Tracking", CVPR 2020) as a TraX worker."""

from typing import Any

from adapting import Setup, main
from pytracking_family import build_pytracking

FACTS = {
    "name": "PrDiMP18",
    "repository": "https://github.com/visionml/pytracking",
    "commit": "7eb9e74bd3d40e29dbcec444902237da13de247b",
    "licence": "GPL-3.0",
    "weights": "prdimp18.pth.tar of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "matplotlib"],
    # pytracking/evaluation/tracker.py reads RGB and passes 0-based boxes
    "colour": "rgb",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "parameter/dimp/prdimp18.py; draws augmentations and start boxes at random, hence the seeds",
}


def build(setup: Setup) -> Any:
    """Return what makes the tracker with the published parameters."""
    return build_pytracking(setup, "dimp", "dimp.prdimp18", _random_network)


def _random_network() -> Any:
    from ltr.models.tracking.dimpnet import klcedimpnet18

    # ltr/train_settings/dimp/prdimp18.py
    return klcedimpnet18(
        filter_size=4, backbone_pretrained=False, optim_iter=5, clf_feat_norm=True, final_conv=True,
        optim_init_step=1.0, optim_init_reg=0.05, optim_min_reg=0.05, gauss_sigma=0.9, alpha_eps=0.05,
        normalize_label=True, init_initializer="zero",
    )  # fmt: skip


if __name__ == "__main__":
    main(FACTS, build)
