"""What can be evaluated: our models, classes that follow the GOT-10k toolkit's contract, and OpenCV's trackers.

On the command line a tracker is

* the name of a shipped model, or a model file;
* ``module:Class``, with ``init(image, box)`` and ``update(image)``, which returns the box;
* an OpenCV tracker that the installed wheel has, as ``TrackerMIL``, or ``TrackerNano=backbone.onnx,head.onnx``.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike

from psiamfcpp.errors import UserError
from psiamfcpp.geometry import FloatArray, Image
from psiamfcpp.tracking import Tracker
from psiamfcpp.zoo import graph_folder, weights_path

# Parameters that hold the model files of OpenCV's trackers, in the order in which they are given.
_OPENCV_FILES = {
    "TrackerNano": ("backbone", "neckhead"),
    "TrackerVit": ("net",),
    "TrackerDaSiamRPN": ("model", "kernel_cls1", "kernel_r1"),
}
_FORMATS = ("rgb", "bgr", "pil")


class Follower(Protocol):
    """A tracker as the evaluation uses it."""

    def init(self, frame: Image, box: FloatArray) -> None:
        """Take up the target in a box ``(x, y, w, h)`` of a frame ``(H, W, 3)`` uint8, BGR."""
        ...

    def update(self, frame: Image) -> ArrayLike:
        """The target's box ``(x, y, w, h)`` in the next frame."""
        ...


@dataclass(frozen=True)
class ModelOptions:
    """How our models run; other trackers have no such options, except for the threads."""

    engine: str | None = None
    """what runs the network"""
    threads: int | None = None
    """threads of a tracker; by default all cores"""
    search_size: int | None = None
    """side of the search crop in pixels"""
    plain: bool = False
    """the published procedure, without states and without looking for a lost target"""


@dataclass(frozen=True)
class TrackerChoice:
    """A tracker and its options: a value that other processes can be told."""

    entry: str
    """what the user gave, with files by their whole path: other processes may have another working directory"""
    kind: str
    """model, class or opencv"""
    options: ModelOptions = ModelOptions()
    folder: str = ""
    """where modules are looked for first"""
    checksum: str = ""
    """of the model files: other files under the same name are another tracker"""

    @property
    def name(self) -> str:
        """What its folder of results is called."""
        if self.kind == "model":
            return Path(self.entry).stem if Path(self.entry).is_file() else Path(self.entry).name
        return self.entry.rpartition(":")[2] if self.kind == "class" else self.entry.partition("=")[0]

    def identity(self) -> dict[str, Any]:
        """What decides the boxes; threads do not, nor does the folder that a model lies in."""
        known = {"entry": self.entry if self.kind == "class" else self.name, "checksum": self.checksum}
        options = {key: value for key, value in asdict(self.options).items() if key != "threads"}
        return {**known, **(options if self.kind == "model" else {})}

    def open(self) -> Follower:
        """The tracker, ready for `init`.

        Raises:
            UserError: there is no such model, module, class or OpenCV tracker, or a file is missing.
        """
        if self.options.threads is not None:
            cv2.setNumThreads(self.options.threads)
        if self.kind == "model":
            return _Ours(self.entry, self.options)
        return _Foreign(self.entry, self.folder) if self.kind == "class" else _OpenCv(self.entry)


def choose(entry: str, options: ModelOptions | None = None) -> TrackerChoice:
    """Understand what the user gave as a tracker; it is not opened yet."""
    kind = "model"
    if entry.startswith("Tracker") and ":" not in entry:
        kind = "opencv"
    elif ":" in entry and not Path(entry).exists():
        kind = "class"
    if kind == "opencv" and _files(entry):
        entry = f"{entry.partition('=')[0]}={','.join(map(_whole, _files(entry)))}"
    elif kind == "model":
        entry = _whole(entry)
    return TrackerChoice(entry, kind, options or ModelOptions(), str(Path.cwd()), _checksum(entry, kind))


def opencv_trackers() -> list[str]:
    """Names of the trackers that the installed OpenCV has."""
    return sorted(name.removesuffix("_create") for name in dir(cv2) if name.startswith("Tracker") and "_create" in name)


def _whole(file: str) -> str:
    """The whole path of a file or folder; anything else as it is."""
    return str(Path(file).resolve()) if Path(file).exists() else file


def _checksum(entry: str, kind: str) -> str:
    found = hashlib.sha256()
    try:
        files = _model_files(entry) if kind == "model" else [Path(file) for file in _files(entry)]
        for file in files:
            found.update(file.read_bytes())
    except (UserError, OSError):
        # opening it will say what is wrong
        return ""
    return found.hexdigest()[:16] if files else ""


def _model_files(entry: str) -> list[Path]:
    """Files of one of our models: a checkpoint, or a folder's graphs."""
    folder = graph_folder(entry)
    return sorted(path for path in folder.iterdir() if path.is_file()) if folder else [weights_path(entry)]


def _files(entry: str) -> list[str]:
    """Model files of an OpenCV tracker."""
    given = entry.partition("=")[2]
    return given.split(",") if given else []


class _Ours:
    def __init__(self, model: str, options: ModelOptions):
        self._tracker = Tracker(model, **asdict(options))

    def init(self, frame: Image, box: FloatArray) -> None:
        self._tracker.init(frame, box)

    def update(self, frame: Image) -> ArrayLike:
        return self._tracker.update(frame).box


def _quiet() -> contextlib.AbstractContextManager[object]:
    """What others print goes to standard error: standard output is for results."""
    return contextlib.redirect_stdout(sys.stderr)


class _Foreign:
    """A class of somebody else's.

    Its attribute ``image_format`` says what it takes: ``"rgb"``, an array ``(H, W, 3)`` uint8 (the default), ``"bgr"``,
    the same in OpenCV's order, or ``"pil"``, an RGB ``PIL.Image``, which the GOT-10k toolkit itself hands out.
    """

    def __init__(self, entry: str, folder: str):
        self._entry = entry
        module, _, name = entry.rpartition(":")
        # where the command was started, as `python -m` has it
        if folder not in sys.path:
            sys.path.insert(0, folder)
        try:
            with _quiet():
                self._tracker = getattr(importlib.import_module(module), name)()
        except Exception as error:
            text = f"tracker {entry!r} cannot be opened ({type(error).__name__}: {error}): module:Class is needed, "
            raise UserError(text + "importable from here and built without arguments") from error
        missing = [call for call in ("init", "update") if not callable(getattr(self._tracker, call, None))]
        if missing:
            raise UserError(f"tracker {entry!r} has no {missing[0]}(): init(image, box) and update(image) are needed")
        self._format = getattr(self._tracker, "image_format", "rgb")
        if self._format not in _FORMATS:
            raise UserError(f"tracker {entry!r} has image_format {self._format!r}: known are {', '.join(_FORMATS)}")

    def init(self, frame: Image, box: FloatArray) -> None:
        self._call("init", self._image(frame), box.copy())

    def update(self, frame: Image) -> ArrayLike:
        box = self._call("update", self._image(frame))
        try:
            return np.asarray(box, np.float64).reshape(4)
        except (TypeError, ValueError):
            raise UserError(f"tracker {self._entry!r} returned {box!r:.60}: a box x,y,w,h is needed") from None

    def _call(self, name: str, *args: Any) -> Any:
        try:
            with _quiet():
                return getattr(self._tracker, name)(*args)
        except Exception as error:
            # the cause stays attached for those who call from Python
            text = f"tracker {self._entry!r} failed in {name}() ({type(error).__name__}: {error}): mend the class"
            raise UserError(text) from error

    def _image(self, frame: Image) -> Any:
        if self._format == "bgr":
            return frame
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        if self._format == "rgb":
            return rgb
        try:
            from PIL import Image as PilImage
        except ModuleNotFoundError:
            raise UserError(f"tracker {self._entry!r} takes PIL images: pip install pillow") from None
        return PilImage.fromarray(rgb)


class _OpenCv:
    """OpenCV's trackers take whole pixels, and are built anew for each target."""

    def __init__(self, entry: str):
        self._name, files = entry.partition("=")[0], _files(entry)
        known = opencv_trackers()
        if self._name not in known:
            raise UserError(f"OpenCV has no {self._name!r} here: there are {', '.join(known)}")
        wanted = _OPENCV_FILES.get(self._name, ())
        if len(files) != len(wanted):
            form = self._name + ("=" + ",".join(f"{part.upper()}.onnx" for part in wanted) if wanted else "")
            raise UserError(f"tracker {entry!r} has {len(files)} model files: give {form}")
        lacking = next((path for path in files if not Path(path).is_file()), None)
        if lacking is not None:
            raise UserError(f"model file {lacking!r} of {self._name} does not exist")
        self._files = dict(zip(wanted, files, strict=True))
        self._create()

    def _create(self) -> Any:
        # it warns of its own network engine at every start
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        try:
            if not self._files:
                return getattr(cv2, f"{self._name}_create")()
            parameters = getattr(cv2, f"{self._name}_Params")()
            for part, path in self._files.items():
                setattr(parameters, part, path)
            return getattr(cv2, f"{self._name}_create")(parameters)
        except cv2.error as error:
            raise UserError(f"OpenCV cannot open {self._name} ({error.err}): check its model files") from None
        finally:
            cv2.utils.logging.setLogLevel(level)

    def init(self, frame: Image, box: FloatArray) -> None:
        self._box: ArrayLike = box
        self._tracker = self._create()
        self._call(self._tracker.init, frame, tuple(round(float(v)) for v in box))

    def update(self, frame: Image) -> ArrayLike:
        found, box = self._call(self._tracker.update, frame)
        # where it sees nothing its box means nothing: the last one stands
        if found:
            self._box = box
        return self._box

    def _call(self, function: Any, *args: Any) -> Any:
        try:
            return function(*args)
        except cv2.error as error:
            raise UserError(f"OpenCV's {self._name} failed: {error.err}") from None
