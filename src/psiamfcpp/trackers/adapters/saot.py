"""SAOT (Zhou et al., "Saliency-Associated Object Tracking", ICCV 2021; SOAT in some tables) as a TraX worker."""

from typing import Any

from adapting import Setup, main
from pytracking_family import build_pytracking

FACTS = {
    "name": "SAOT",
    "repository": "https://github.com/ZikunZhou/SAOT",
    "commit": "83ca991b2c50e7256ecbf4b381270fc2b7755b2d",
    "licence": "none stated; derived from PyTracking (GPL-3.0)",
    "weights": "SAOT.pth of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "matplotlib"],
    # pytracking/evaluation/tracker.py reads RGB and passes 0-based boxes
    "colour": "rgb",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "option parameters: a file of pytracking/parameter/saot, by default saot_otb",
}


def build(setup: Setup) -> Any:
    """Return what makes the tracker with published parameters."""
    return build_pytracking(setup, "saot", "saot." + setup.options.get("parameters", "saot_otb"), _random_network)


def _random_network() -> Any:
    raise RuntimeError("SAOT's network needs its training settings: random weights cannot be had")


if __name__ == "__main__":
    main(FACTS, build)
