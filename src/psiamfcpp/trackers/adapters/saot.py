"""SAOT (Zhou et al., "Saliency-Associated Object Tracking", ICCV 2021; SOAT in some tables) as a TraX worker."""

import sys
from typing import Any

from adapting import Setup, main
from pytracking_family import build_pytracking

FACTS = {
    "name": "SAOT",
    "repository": "https://github.com/ZikunZhou/SAOT",
    "commit": "83ca991b2c50e7256ecbf4b381270fc2b7755b2d",
    "licence": "none stated; derived from PyTracking (GPL-3.0)",
    "weights": "SAOT.pth of the repository's model zoo",
    "modules": ["torch", "torchvision", "cv2", "matplotlib", "yacs"],
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


class _TrainingStoppedError(Exception):
    """Carries the network out of the training script."""


def _random_network() -> Any:
    """Return the network that ltr/train_settings/dimp/saot.py would train: it alone has the network's settings."""
    from unittest.mock import MagicMock

    # what reads the training data, and trains
    for name in ("dataset", "data", "data.transforms", "actors", "trainers", "models.loss"):
        sys.modules["ltr." + name] = MagicMock()
    import ltr.train_settings.dimp.saot as training

    build_network = training.dimpnet.dimpnet50

    def stop(**settings: Any) -> None:
        settings["backbone_pretrained"] = False
        raise _TrainingStoppedError(build_network(**settings))

    training.dimpnet.dimpnet50 = stop
    settings = MagicMock()
    settings.local_rank = -1
    try:
        training.run(settings)
    except _TrainingStoppedError as built:
        return built.args[0]
    finally:
        training.dimpnet.dimpnet50 = build_network
    raise RuntimeError("SAOT's training script builds no network")


if __name__ == "__main__":
    main(FACTS, build)
