"""What the adapters have in common: they build a published tracker in its own environment, and serve it over TraX.

Like the server, this needs Python 3.6 and NumPy alone.
"""

import argparse
import collections.abc
import importlib.util
import os
import random
import sys
import types
from pathlib import Path
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

import numpy as np
from trax_worker import Box, Properties, ProtocolError, Session, claim_streams


class Setup(NamedTuple):
    """What an adapter builds its tracker from."""

    checkout: str
    """folder of the tracker's repository; it is on ``sys.path``"""
    weights: str
    """weights file, or an empty string for random weights"""
    device: str
    """cpu or cuda"""
    options: Dict[str, str]
    """anything else that the user gave"""


def seed_everything(threads: int, seed: int = 0) -> None:
    """Set the seeds of Python, NumPy and torch, and the threads of torch, where it is imported already."""
    random.seed(seed)
    np.random.seed(seed)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
        torch.set_num_threads(threads)


def adapt_numpy() -> None:
    """Give NumPy back the names that it dropped in version 1.24, and research code of its time uses."""
    for name, kind in (("float", float), ("int", int), ("bool", bool), ("object", object)):
        if name not in np.__dict__:
            setattr(np, name, kind)


def adapt_torch(device: str) -> None:
    """Let research code of its time run with the torch of today, and on the CPU where that is asked for.

    * Weights files are pickles of the authors; since torch 2.6 `torch.load` refuses them by itself.
    * ``torchvision.models.resnet.model_urls`` is gone since torchvision 0.13; only pre-training used it.
    * ``torch._six`` is gone since torch 1.13, ``collections.Iterable`` and its like since Python 3.10.
    * ``torch.rfft`` and ``torch.irfft`` are gone since torch 1.8.
    * Nothing is fetched: weights come from the user's file.
    * Without a GPU, ``.cuda()`` and ``.to("cuda")`` stay on the CPU.
    """
    import torch
    import torch.utils.model_zoo

    load = torch.load

    def load_file(*args: Any, **kwargs: Any) -> Any:
        if "weights_only" in load.__code__.co_varnames:
            kwargs.setdefault("weights_only", False)
        if device == "cpu":
            kwargs["map_location"] = "cpu"
        return load(*args[:1], **kwargs)

    def refuse(url: str, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError(f"the tracker wants to fetch {url}: give it a weights file")

    torch.load = load_file
    torch.hub.load_state_dict_from_url = refuse
    torch.utils.model_zoo.load_url = refuse
    try:
        import torchvision.models.resnet as resnet
    except ImportError:
        resnet = None
    if resnet is not None and not hasattr(resnet, "model_urls"):
        resnet.model_urls = dict.fromkeys(("resnet18", "resnet34", "resnet50", "resnet101", "resnet152"), "weights")
    for name in collections.abc.__all__:
        if not hasattr(collections, name):
            setattr(collections, name, getattr(collections.abc, name))
    if importlib.util.find_spec("torch._six") is None:
        six = types.ModuleType("torch._six")
        six.container_abcs, six.string_classes, six.int_classes = collections.abc, (str, bytes), int
        sys.modules["torch._six"] = six
    if not hasattr(torch, "rfft"):
        torch.rfft, torch.irfft = _rfft, _irfft
    if device == "cpu":
        _stay_on_cpu(torch)


def _rfft(signal: Any, dimensions: int) -> Any:
    import torch

    return torch.view_as_real(torch.fft.rfftn(signal, dim=list(range(-dimensions, 0))))


def _irfft(spectrum: Any, dimensions: int, signal_sizes: Any = None) -> Any:
    import torch

    sizes = None if signal_sizes is None else [int(size) for size in signal_sizes]
    values = torch.view_as_complex(spectrum.contiguous())
    return torch.fft.irfftn(values, s=sizes, dim=list(range(-dimensions, 0)))


def _stay_on_cpu(torch: Any) -> None:
    def here(self: Any, *args: Any, **kwargs: Any) -> Any:
        return self

    def elsewhere(place: Any) -> Any:
        named = isinstance(place, (str, torch.device)) and str(place).startswith("cuda")
        return "cpu" if named else place

    def staying(move: Any) -> Any:
        def to(self: Any, *args: Any, **kwargs: Any) -> Any:
            return move(self, *map(elsewhere, args), **{key: elsewhere(value) for key, value in kwargs.items()})

        return to

    for kind in (torch.Tensor, torch.nn.Module):
        kind.cuda = here
        kind.to = staying(kind.to)
    torch.cuda.current_device = lambda: 0


class _Absent(types.ModuleType):
    """A module in which every name is a class that nothing is made of."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        # a package, so that modules inside of it may be named
        self.__path__ = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def leave_out(*names: str) -> None:
    """Let modules be imported without being there: those that the tracker's code names, but tracking never uses.

    Args:
        names: modules of the checkout, which are left out in any case, by their whole names, and packages, which are
            used where they are installed.
    """
    for name in names:
        top = name.split(".")[0]
        ours = Path(sys.path[0], top).is_dir()
        if ours or top in sys.modules or importlib.util.find_spec(top) is None:
            sys.modules.setdefault(name, _Absent(name))


class PysotStyle:
    """Trackers with ``init(image, box)`` and ``track(image)["bbox"]``, as in PySOT."""

    def __init__(self, tracker: Any) -> None:
        self._tracker = tracker

    def init(self, image: Any, box: List[float]) -> None:
        """Start on a box."""
        self._tracker.init(image, box)

    def update(self, image: Any) -> Any:
        """Return box and score of the next image."""
        found = self._tracker.track(image)
        return found["bbox"], found.get("best_score")


class PytrackingStyle:
    """Trackers with ``initialize(image, {"init_bbox": box})`` and ``track(image)["target_bbox"]``, as in PyTracking.

    Args:
        tracker: the tracker, or what makes a new one for each target.
        score: key of the score in what `track` returns; of several values the highest counts.
    """

    def __init__(self, tracker: Any, score: str = "") -> None:
        self._make = tracker if callable(tracker) else lambda: tracker
        self._score = score

    def init(self, image: Any, box: List[float]) -> None:
        """Start on a box."""
        self._tracker = self._make()
        self._tracker.initialize(image, {"init_bbox": box})

    def update(self, image: Any) -> Any:
        """Return box and score of the next image."""
        found = self._tracker.track(image)
        return found["target_bbox"], float(np.max(found[self._score])) if self._score else None


def box_and_score(answer: Any) -> Tuple[Any, Optional[float]]:
    """Return the box ``(4,)`` and the score, or None, of what a tracker's `update` returned.

    Raises:
        ValueError: it is neither a box of four finite numbers, nor a pair of a box and a score.
    """
    box, score = answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)
    try:
        values = np.asarray(box, float).reshape(4)
    except (TypeError, ValueError):
        raise ValueError(f"update() returned {answer!r:.60}: a box x,y,w,h is needed") from None
    if not np.isfinite(values).all():
        raise ValueError(f"update() returned a box that is not finite: {values}")
    return values, None if score is None else float(score)


def main(facts: Dict[str, Any], build: Callable[[Setup], Any]) -> None:
    """Run an adapter: build the tracker, then serve it until the client ends the conversation.

    Args:
        facts: what the adapter says of its tracker; ``colour`` (rgb or bgr) and ``origin`` (0 or 1, where the
            tracker counts its pixels from) are applied here.
        build: makes the tracker: an object with ``init(image, box)`` and ``update(image)``, which returns a box
            ``(x, y, w, h)`` or a pair of box and score.
    """
    streams = claim_streams()
    # the adapters themselves are no modules for the tracker
    here = Path(__file__).resolve().parent
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]
    parser = argparse.ArgumentParser(description=facts["name"])
    parser.add_argument("--checkout", required=True)
    parser.add_argument("--weights", default="")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    args = parser.parse_args()
    checkout = str(Path(args.checkout).resolve())
    options = dict(pair.split("=", 1) for pair in args.set)
    setup = Setup(checkout, str(Path(args.weights).resolve()) if args.weights else "", args.device, options)
    sys.path.insert(0, checkout)
    # research code opens its configurations by relative paths
    os.chdir(checkout)
    os.environ.setdefault("OMP_NUM_THREADS", str(args.threads))
    if args.device == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    adapt_numpy()
    if "torch" in facts["modules"]:
        adapt_torch(args.device)
    seed_everything(args.threads)
    tracker = build(setup)
    session = Session(streams, facts["name"])
    origin = np.array([facts["origin"], facts["origin"], 0, 0], float)

    def colours(image: Any) -> Any:
        return np.ascontiguousarray(image if facts["colour"] == "rgb" else image[:, :, ::-1])

    def init(image: Any, box: Box) -> Tuple[Any, Properties]:
        # one worker follows many targets: each has the seeds of the first
        seed_everything(args.threads)
        tracker.init(colours(image), [float(value) for value in np.array(box) + origin])
        return box, {}

    def update(image: Any) -> Tuple[Any, Properties]:
        box, score = box_and_score(tracker.update(colours(image)))
        return box - origin, {} if score is None else {"confidence": repr(score)}

    try:
        session.run(init, update)
    except ProtocolError:
        raise
    except Exception as error:
        session.fail(f"{type(error).__name__}: {error}")
        raise
