"""HiFT (Cao et al., "HiFT: Hierarchical Feature Transformer for Aerial Tracking", ICCV 2021) as a TraX worker."""

from typing import Any

from adapting import PysotStyle, Setup, main

FACTS = {
    "name": "HiFT",
    "repository": "https://github.com/vision4robotics/HiFT",
    "commit": "b66d3eb2c298769830321c66b0495bbfcd4e70c3",
    "licence": "none stated",
    "weights": "general_model.pth of the repository's README",
    "modules": ["torch", "cv2", "yacs", "yaml"],
    # pysot/tracker/hift_tracker.py; tools/test.py hands on what OpenCV reads
    "colour": "bgr",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "the hyper-parameters of experiments/config.yaml",
}


def build(setup: Setup) -> Any:
    """Return the tracker of tools/test.py."""
    from pysot.core.config import cfg
    from pysot.models.model_builder import ModelBuilder
    from pysot.tracker.hift_tracker import HiFTTracker
    from pysot.utils.model_load import load_pretrain

    cfg.merge_from_file("experiments/config.yaml")
    cfg.CUDA = setup.device == "cuda"
    model = ModelBuilder()
    if setup.weights:
        model = load_pretrain(model, setup.weights)
    return PysotStyle(HiFTTracker(model.cuda().eval()))


if __name__ == "__main__":
    main(FACTS, build)
