"""Stand-ins for the repositories of published trackers: the same modules and calls, but a tracker that sees colours.

A target is a rectangle of pure red. A stand-in looks for it in the channel order of its original, checks that the first
box is that rectangle in its original's convention, and returns boxes in that convention. A wrong colour order or a
wrong convention is an error of the stand-in, therefore.
"""

from __future__ import annotations

from pathlib import Path

WEIGHTS = "the weights"

_SEE = """
import numpy as np

def see(image, red, origin):
    assert image.dtype == np.uint8 and image.flags["C_CONTIGUOUS"]
    rows, columns = np.nonzero((image[:, :, red] > 200) & (image[:, :, 2 - red] < 50))
    assert rows.size, "no red target: wrong colour order"
    x, y = columns.min(), rows.min()
    return [float(v) for v in (x + origin, y + origin, columns.max() - x + 1, rows.max() - y + 1)]

def check(image, box, red, origin):
    assert np.allclose(see(image, red, origin), box), "the first box is %s: wrong convention" % list(box)

def check_weights(path):
    assert open(path).read() == "the weights"
"""

_TORCH = {
    "torch/__init__.py": """
import contextlib
from torch import cuda, hub, nn, utils
class device:
    pass
class Tensor:
    def to(self, *args, **kwargs):
        return self
def load(path, map_location=None, weights_only=True):
    assert map_location == "cpu" and not weights_only
    return open(path).read()
def manual_seed(seed):
    utils.seeds.append(seed)
def set_num_threads(count):
    utils.threads = count
no_grad = contextlib.nullcontext
""",
    "torch/cuda.py": "",
    "torch/hub.py": "",
    "torch/nn/functional.py": "def pad(image, sizes): return sizes\n",
    "torch/nn/__init__.py": """
class Module:
    def cuda(self):
        raise AssertionError("there is no GPU")
    def to(self, place):
        assert "cuda" not in str(place), "there is no GPU"
        return self
    def eval(self):
        return self
""",
    "torch/utils/__init__.py": "seeds, threads = [], None\n",
    "torch/utils/model_zoo.py": "",
    "torchvision/__init__.py": "__version__ = '0.28.0'\n",
}

_PYSOT = {
    "pysot/core/config.py": """
class Node(dict):
    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__
    def merge_from_file(self, path):
        self.update(config=open(path).read())
cfg = Node(CUDA=True, TRACK=Node(), HP_SEARCH=Node(UAV123=[1, 2, 3]))
""",
    "pysot/utils/model_load.py": """
import standin
def load_pretrain(model, path):
    standin.check_weights(path)
    return model
""",
}

_PYSOT_TRACKER = """
import standin
from pysot.core.config import cfg
class NAMETracker:
    def __init__(self, model):
        assert cfg.config == "a configuration"
    def init(self, image, box):
        standin.check(image, box, 2, 0)
    def track(self, image):
        return {"bbox": standin.see(image, 2, 0)}
"""

_PYTRACKING = {
    "ltr/__init__.py": "",
    "pytracking/__init__.py": """
from pytracking.run_tracker import run_tracker
from pytracking.evaluation.tracker import Tracker
""",
    "pytracking/evaluation/__init__.py": "",
    "pytracking/params.py": """
import standin
class Net:
    use_gpu, net_path, net = True, "", None
    def initialize(self):
        standin.check_weights(self.net_path)
class Params:
    use_gpu = True
    def __init__(self):
        self.net = Net()
""",
}

_PYTRACKING_TRACKER = """
import standin
from ltr.external.PreciseRoIPooling.pytorch.prroi_pool import PrRoIPool2D, prroi_pool2d
class Tracker:
    def __init__(self, params):
        assert not params.use_gpu and not params.net.use_gpu
    def initialize(self, image, info):
        assert self.features_initialized
        standin.check(image, info["init_bbox"], 0, 0)
    def track(self, image):
        return {"target_bbox": standin.see(image, 0, 0)}
def get_tracker_class():
    return Tracker
"""


def _pytracking(tracker: str, parameters: str) -> dict[str, str]:
    return {
        **_TORCH,
        **_PYTRACKING,
        f"pytracking/tracker/{tracker}/__init__.py": _PYTRACKING_TRACKER,
        f"pytracking/parameter/{parameters}.py": "from pytracking.params import Params as parameters\n",
    }


CHECKOUTS: dict[str, dict[str, str]] = {
    "transt": {
        **_TORCH,
        "ltr/models/backbone/__init__.py": "def resnet50(pretrained): assert not pretrained\n",
        "pysot_toolkit/trackers/net_wrappers.py": """
import standin
class NetWithBackbone:
    def __init__(self, net_path, use_gpu):
        assert not use_gpu
        standin.check_weights(net_path)
""",
        "pysot_toolkit/trackers/tracker.py": """
import numpy as np
import standin
import ltr.models.backbone
class Tracker:
    def __init__(self, name, net, window_penalty, exemplar_size, instance_size):
        ltr.models.backbone.resnet50(pretrained=True)
        assert (window_penalty, exemplar_size, instance_size) == (0.49, 128, 256)
    def initialize(self, image, info):
        standin.check(image, info["init_bbox"], 0, 0)
    def track(self, image):
        return {"target_bbox": standin.see(image, 0, 0), "best_score": np.array([0.1, 0.75])}
""",
    },
    "siamgat": {
        **_TORCH,
        **_PYSOT,
        "experiments/siamgat_googlenet/config.yaml": "a configuration",
        "pysot/models/model_builder_gat.py": "import torch\nclass ModelBuilder(torch.nn.Module): pass\n",
        "pysot/tracker/siamgat_tracker.py": _PYSOT_TRACKER.replace("NAME", "SiamGAT"),
    },
    "hift": {
        **_TORCH,
        **_PYSOT,
        "experiments/config.yaml": "a configuration",
        "pysot/models/model_builder.py": "import torch\nclass ModelBuilder(torch.nn.Module): pass\n",
        "pysot/tracker/hift_tracker.py": _PYSOT_TRACKER.replace("NAME", "HiFT"),
    },
    "lighttrack": {
        **_TORCH,
        "lib/models/models.py": """
import torch
class LightTrackM_Subnet(torch.nn.Module):
    def __init__(self, path, stride):
        assert stride == 16 and path.startswith("back_")
""",
        "lib/utils/utils.py": """
import standin
def load_pretrain(model, path):
    standin.check_weights(path)
    return model
def cxy_wh_2_rect(place, size):
    return [place[0] - size[0] / 2, place[1] - size[1] / 2, size[0], size[1]]
""",
        "lib/tracker/lighttrack.py": """
import numpy as np
import standin
from lib.utils.utils import cxy_wh_2_rect
class Lighttrack:
    def __init__(self, info, even):
        assert (info.dataset, info.stride, even) == ("VOT2019", 16, 0)
    def init(self, image, place, size, net):
        standin.check(image, cxy_wh_2_rect(place, size), 0, 0)
        return {}
    def track(self, state, image):
        x, y, w, h = standin.see(image, 0, 0)
        return {"target_pos": np.array([x + w / 2, y + h / 2]), "target_sz": np.array([w, h])}
""",
    },
    "automatch": {
        **_TORCH,
        "experiments/AutoMatch.yaml": "",
        "easydict.py": """
class EasyDict(dict):
    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__
""",
        "lib/utils/read_file.py": """
from easydict import EasyDict
def load_yaml(path):
    open(path)
    return {"TEST": EasyDict()}
""",
        "lib/utils/sot_builder.py": """
import torch
class Siamese_builder:
    def __init__(self, config):
        assert config.TEST.DATA == "UAV123"
    def build(self):
        return torch.nn.Module()
""",
        "lib/utils/model_helper.py": """
import standin
def load_pretrain(model, path, addhead, print_unuse):
    standin.check_weights(path)
    return model
""",
        "lib/utils/box_helper.py": """
def cxy_wh_2_rect(place, size):
    return [place[0] - size[0] / 2, place[1] - size[1] / 2, size[0], size[1]]
""",
        "lib/tracker/sot_tracker.py": """
import numpy as np
import standin
from utils.box_helper import cxy_wh_2_rect
class SiamTracker:
    def __init__(self, config):
        pass
    def init(self, inputs):
        standin.check(inputs["image"], cxy_wh_2_rect(inputs["pos"], inputs["sz"]), 2, 0)
    def track(self, image):
        x, y, w, h = standin.see(image, 2, 0)
        return {"pos": np.array([x + w / 2, y + h / 2]), "sz": np.array([w, h]), "score": 0.5}
""",
    },
    "d3s": {
        **_TORCH,
        "cv2.py": "__version__ = '5.0.0'\n",
        "matplotlib.py": "def use(backend): assert backend == 'Agg'\n",
        "ltr/models/backbone/resnet.py": """
class Net:
    def load_state_dict(self, state):
        assert state == "the backbone"
def resnet50(output_layers, pretrained):
    assert not pretrained
    return Net()
""",
        "pytracking/__init__.py": """
class TensorList(list):
    def __getattr__(self, name):
        return name
""",
        "pytracking/features/extractor.py": "class MultiResolutionExtractor: pass\n",
        "pytracking/parameter/segm/default_params.py": """
from types import SimpleNamespace as Params
def parameters():
    return Params(debug=1, visualization=True, use_gpu=True)
""",
        "pytracking/tracker/segm/segm.py": """
import matplotlib
import standin
import ltr.models.backbone.resnet as resnet
from pytracking import TensorList
from torch import nn
def pad(image, sizes):
    import torch.nn.functional as functional
    return functional.pad(image, sizes)
matplotlib.use("TkAgg")
class Segm:
    def __init__(self, params):
        assert params.use_gpu and params.device == "cpu" and not params.debug
        standin.check_weights(params.segm_net_path)
        resnet.resnet50(output_layers=["layer3"], pretrained=True)
        assert pad(None, [1.0, 2.0]) == [1, 2]
        assert not hasattr(TensorList(), "__torch_function__") and TensorList().apply == "apply"
    def initialize(self, image, state):
        assert isinstance(state, list)
        standin.check(image, state, 0, 1)
    def track(self, image):
        return standin.see(image, 0, 1)
""",
    },
    "prdimp18": _pytracking("dimp", "dimp/prdimp18"),
    "kys": _pytracking("kys", "kys/default"),
    "saot": _pytracking("saot", "saot/saot_otb"),
    "siamrcnn": {
        "tracking/three_stage_tracker.py": """
import numpy as np
import standin
class ThreeStageTracker:
    def __init__(self, model):
        kind, _, path = model.partition(":")
        assert kind == "checkpoint"
        standin.check_weights(path)
    def init(self, image, box):
        standin.check(image, box, 0, 0)
        box[2:] += box[:2]
    def update(self, image, use_confidences):
        return np.array(standin.see(image, 0, 0)), 0.9
""",
    },
}


def make_checkout(folder: Path, name: str, lost: bool = False) -> dict[str, str]:
    """Write the stand-in for an adapter.

    Args:
        folder: to write to.
        name: of the adapter.
        lost: make the tracker return nothing.

    Returns:
        The options that open the adapter on it.
    """
    checkout = folder / "checkout"
    files = {**CHECKOUTS[name], "standin.py": _SEE}
    if lost:
        files["standin.py"] += "\nsee_all = see\ndef see(*args):\n    return LOST\nLOST = None\n"
        files["standin.py"] += "def check(image, box, red, origin):\n    pass\n"
    for path, text in files.items():
        file = checkout / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    weights, backbone = folder / "weights.pth", folder / "backbone.pth"
    weights.write_text(WEIGHTS)
    backbone.write_text("the backbone")
    options = {"checkout": str(checkout), "weights": str(weights)}
    return {**options, "backbone": str(backbone)} if name == "d3s" else options
