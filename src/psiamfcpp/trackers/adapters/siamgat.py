"""SiamGAT (Guo et al., "Graph Attention Tracking", CVPR 2021) as a TraX worker."""

from typing import Any

from adapting import PysotStyle, Setup, main

FACTS = {
    "name": "SiamGAT",
    "repository": "https://github.com/ohhhyeahhh/SiamGAT",
    "commit": "eab3e94f9c9d44c1b007b2b63bdf75129443dd40",
    "licence": "none stated",
    "weights": "the model for OTB100 and UAV123 of the repository's README",
    "modules": ["torch", "cv2", "yacs", "yaml"],
    # pysot/tracker/siamgat_tracker.py; tools/testTracker.py hands on what OpenCV reads
    "colour": "bgr",
    "origin": 0,
    "threads": "torch.set_num_threads and OMP_NUM_THREADS, as given",
    "seeds": "Python, NumPy, torch: 0 before each target",
    "notes": "needs NumPy below 2 (ndarray.ptp); option dataset: whose hyper-parameters, by default UAV123",
}


def build(setup: Setup) -> Any:
    """Return the tracker of tools/testTracker.py."""
    from pysot.core.config import cfg
    from pysot.models.model_builder_gat import ModelBuilder
    from pysot.tracker.siamgat_tracker import SiamGATTracker
    from pysot.utils.model_load import load_pretrain

    cfg.merge_from_file("experiments/siamgat_googlenet/config.yaml")
    values = getattr(cfg.HP_SEARCH, setup.options.get("dataset", "UAV123"))
    cfg.TRACK.LR, cfg.TRACK.PENALTY_K, cfg.TRACK.WINDOW_INFLUENCE = values
    cfg.CUDA = setup.device == "cuda"
    model = ModelBuilder()
    if setup.weights:
        model = load_pretrain(model, setup.weights)
    return PysotStyle(SiamGATTracker(model.cuda().eval()))


if __name__ == "__main__":
    main(FACTS, build)
