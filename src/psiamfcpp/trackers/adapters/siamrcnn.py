"""Siam R-CNN (Voigtlaender et al., "Siam R-CNN: Visual Tracking by Re-Detection", CVPR 2020) as a TraX worker."""

from typing import Any, List

import numpy as np
from adapting import Setup, main

FACTS = {
    "name": "SiamR-CNN",
    "repository": "https://github.com/VisualComputingInstitute/SiamR-CNN",
    "commit": "df9b428aeb90da0c8b2c8076f54f632efb07366c",
    "licence": "MIT",
    "weights": "the checkpoint train_log/hard_mining3/model-1360500 (.index names it) of the repository's README",
    "modules": ["tensorflow", "tensorpack", "got10k", "cv2", "scipy"],
    # tracking/argmax_tracker.py turns what PIL reads to BGR itself; main_trax.py passes TraX boxes as they are
    "colour": "rgb",
    "origin": 0,
    "threads": "OMP_NUM_THREADS; TensorFlow's own pools are left as they are",
    "seeds": "Python, NumPy: 0 before each target",
    "notes": "TensorFlow 1.15 and thus Python 3.7 or older; tensorpack at d24a9230, got10k-toolkit of pvoigtlaender",
}


class _Tracker:
    def __init__(self, tracker: Any) -> None:
        self._tracker = tracker

    def init(self, image: Any, box: List[float]) -> None:
        # it changes the box
        self._tracker.init(image, np.array(box))

    def update(self, image: Any) -> Any:
        box, score = self._tracker.update(image, use_confidences=True)
        return box, score


def build(setup: Setup) -> Any:
    """Return the tracker of main_trax.py."""
    from tracking.three_stage_tracker import ThreeStageTracker

    if not setup.weights:
        raise ValueError("SiamR-CNN loads its graph from a checkpoint: random weights cannot be had")
    return _Tracker(ThreeStageTracker(model="checkpoint:" + setup.weights.replace(".index", "")))


if __name__ == "__main__":
    main(FACTS, build)
