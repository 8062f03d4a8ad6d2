"""Opens any tracker from a string, so that every command takes every tracker.

A tracker is written ``NAME`` or ``KIND:NAME``, then ``,key=value`` for its options:

===========================================  ==========================================================
``psiamfcpp-alexnet-int8,plain=true``        our models, by name or file; keys are those of `TrackerOptions`
``opencv:mil``, ``opencv:nano,backbone=A,    a tracker that the installed OpenCV has; ``TrackerMIL`` and
neckhead=B``                                 ``TrackerNano=A,B`` are the same
``dcf:kcf``                                  a correlation filter
``nanotrack:v3,backbone=A,head=B``           NanoTrack, from the user's files
``module:pkg.mod:Class,key=value``           a class with ``init(image, box)`` and ``update(image)``, built with
                                             the given keys; ``pkg.mod:Class`` is the same
``adapter:transt,checkout=DIR,weights=FILE,  a published tracker in its own interpreter
python=PY``
``trax:COMMAND``                             any program that speaks TraX; the rest of the string is its command
===========================================  ==========================================================
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from psiamfcpp.errors import UserError
from psiamfcpp.trackers.contract import Tracker
from psiamfcpp.trackers.identity import checksum
from psiamfcpp.trackers.siamfcpp.options import TrackerOptions
from psiamfcpp.trackers.siamfcpp.tracker import Tracker as OurTracker
from psiamfcpp.trackers.siamfcpp.tracker import model_identity
from psiamfcpp.trackers.trax.client import trax_name
from psiamfcpp.zoo import model_files


class Kind(NamedTuple):
    """Where trackers of one kind are opened."""

    module: str
    """has ``open_tracker(name, options) -> Tracker``"""
    threads: bool = False
    """``open_tracker`` takes ``threads`` among the options"""
    worker: bool = False
    """opening starts a process; ``identity(name, options)`` says what decides the boxes without it"""


KINDS: dict[str, Kind] = {
    "opencv": Kind("psiamfcpp.trackers.opencv"),
    "dcf": Kind("psiamfcpp.trackers.dcf"),
    "nanotrack": Kind("psiamfcpp.trackers.nanotrack", threads=True),
    "module": Kind("psiamfcpp.trackers.foreign"),
    "adapter": Kind("psiamfcpp.trackers.trax.adapter", threads=True, worker=True),
    "trax": Kind("psiamfcpp.trackers.trax.client", threads=True, worker=True),
}

_MODEL = "model"
# Options that decide no box.
_UNSEEN = ("threads", "python", "timeout")
_DEFAULT = TrackerOptions()


@dataclass(frozen=True)
class TrackerChoice:
    """A tracker that was chosen but is not open yet: a value that other processes can be given."""

    kind: str
    """model, or one of `KINDS`"""
    entry: str
    """name within the kind; of a model file the whole path, since other processes may work in another folder"""
    given: tuple[tuple[str, str], ...] = ()
    """options in the string, files by their whole path"""
    options: TrackerOptions = _DEFAULT
    """how a model runs; other trackers take the threads from it"""
    alias: str = ""
    """the name that an alias such as ``TrackerMIL`` shows instead of its own"""
    folder: str = ""
    """where modules are searched first"""
    checksum: str = ""
    """of a model's files: other files under the same name are another tracker"""
    label: str = ""
    """what tables and folders of results call it instead of its name; it decides no box"""

    @property
    def name(self) -> str:
        """What tables and folders of results call it."""
        if self.label or self.alias:
            return self.label or self.alias
        if self.kind == _MODEL:
            path = Path(self.entry)
            named = path.stem if path.is_file() else path.name
        elif self.kind == "module":
            named = self.entry.rpartition(":")[2]
        else:
            named = f"{self.kind}-{trax_name(self.entry) if self.kind == 'trax' else self.entry}"
        shown = [f",{key}={value}" for key, value in self.given if key not in _UNSEEN and not Path(value).exists()]
        return named + "".join(shown).replace(":", "-").replace("/", "-")

    def identity(self) -> dict[str, Any]:
        """Return what decides the boxes; threads do not, nor does the folder that a model lies in.

        Raises:
            UserError: see `open`; trackers other than models and workers are opened to ask them.
        """
        kind = KINDS.get(self.kind)
        if kind is not None and kind.worker:
            return dict(importlib.import_module(kind.module).identity(self.entry, dict(self.given)))
        if self.kind == _MODEL:
            path = Path(self.entry)
            return model_identity(path.stem if path.is_file() else path.name, self.checksum, self.options)
        tracker = self.open()
        try:
            found = dict(tracker.identity)
        finally:
            tracker.close()
        return {**found, "entry": self.alias} if self.alias else found

    def open(self) -> Tracker:
        """Open the tracker, ready for `init`.

        Raises:
            UserError: there is no such tracker, or a file or an option is missing or wrong.
        """
        if self.options.threads is not None:
            cv2.setNumThreads(self.options.threads)
        if self.kind == _MODEL:
            return OurTracker(self.entry, options=self.options)
        # where the command was started, as `python -m` has it
        if self.kind == "module" and self.folder not in sys.path:
            sys.path.insert(0, self.folder)
        kind, given = KINDS[self.kind], dict(self.given)
        if kind.threads and self.options.threads is not None:
            given.setdefault("threads", str(self.options.threads))
        opened: Tracker = importlib.import_module(kind.module).open_tracker(self.entry, given)
        return opened


def open_tracker(text: str, options: TrackerOptions = _DEFAULT) -> Tracker:
    """Open a tracker of any kind; see the top of this module for how they are written.

    Args:
        text: the tracker.
        options: how a model runs; keys in ``text`` go before these.

    Raises:
        UserError: there is no such tracker, or a file or an option is missing or wrong.
    """
    return choose(text, options).open()


def choose(text: str, options: TrackerOptions = _DEFAULT) -> TrackerChoice:
    """Understand what the user gave as a tracker, without opening it; takes what `open_tracker` takes.

    Raises:
        UserError: an option is not written as key=value, or no model has it.
    """
    if Path(text).exists():
        return _model(text, {}, options)
    if text.startswith("Tracker") and ":" not in text:
        return _opencv_alias(text, options)
    kind, colon, rest = text.partition(":")
    if colon and kind == "trax":
        return TrackerChoice(kind, rest, options=options)
    head, *pairs = text.split(",")
    given = dict(_pair(text, pair) for pair in pairs)
    kind, colon, name = head.partition(":")
    if not colon or Path(head).exists():
        return _model(head, given, options)
    if kind not in KINDS:
        kind, name = "module", head
    return TrackerChoice(kind, name, _whole_paths(given), options, folder=str(Path.cwd()))


def _model(name: str, given: Mapping[str, str], options: TrackerOptions) -> TrackerChoice:
    fields = {field.name: str(field.type) for field in dataclasses.fields(TrackerOptions)}
    unknown = next((key for key in given if key not in fields), None)
    if unknown is not None:
        raise UserError(f"tracker {name} has no option {unknown!r}: known are {', '.join(fields)}")
    changes = {key: _value(name, key, value, fields[key]) for key, value in given.items()}
    options = dataclasses.replace(options, **changes)
    entry = str(Path(name).resolve()) if Path(name).exists() else name
    try:
        found = checksum(model_files(entry))
    except (UserError, OSError):
        # opening it will say what is wrong
        found = ""
    return TrackerChoice(_MODEL, entry, tuple(given.items()), options, checksum=found)


def _opencv_alias(text: str, options: TrackerOptions) -> TrackerChoice:
    from psiamfcpp.trackers.opencv import FILES

    alias, _, files = text.partition("=")
    name = alias.removeprefix("Tracker").lower()
    paths, wanted = files.split(",") if files else [], FILES.get(alias, ())
    if len(paths) != len(wanted):
        form = alias + ("=" + ",".join(f"{part.upper()}.onnx" for part in wanted) if wanted else "")
        raise UserError(f"tracker {text!r} has {len(paths)} model files: give {form}")
    return TrackerChoice("opencv", name, _whole_paths(dict(zip(wanted, paths, strict=True))), options, alias)


def _pair(text: str, pair: str) -> tuple[str, str]:
    key, sign, value = pair.partition("=")
    if not sign or not key:
        raise UserError(f"tracker {text!r}: {pair!r} is not KEY=VALUE")
    return key.strip().replace("-", "_"), value.strip()


def _value(name: str, key: str, value: str, kind: str) -> Any:
    if kind == "bool" and value.lower() in ("true", "false"):
        return value.lower() == "true"
    if kind == "int | None" and value.isdecimal():
        return int(value)
    if kind.startswith("str"):
        return value
    expected = "true or false" if kind == "bool" else "a whole number"
    raise UserError(f"tracker {name}: {key} is {value!r}, but {expected} is expected")


def _whole_paths(given: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple((key, str(Path(value).resolve()) if Path(value).exists() else value) for key, value in given.items())
