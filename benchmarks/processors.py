"""Compare what 8-bit models find on one processor with what they find on another.

    python benchmarks/processors.py record here.npz [--models MODEL ...]
    python benchmarks/processors.py compare here.npz [--frames 60]

`record` follows the target of the first frames of the demo. It writes the frames, boxes and states, and the graphs'
answers on some crops. `compare` does the same on the frames and crops of the file, and prints how far the two are
apart. It fails where the mean overlap of the boxes is below 0.98 or a state differs. To compare two processors, copy
the file to the other computer.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import tyro
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from psiamfcpp import Tracker
from psiamfcpp.demo.clip import render
from psiamfcpp.errors import UserError
from psiamfcpp.evaluation.speed import machine
from psiamfcpp.export.crops import Pair
from psiamfcpp.export.parity import compare as compare_answers
from psiamfcpp.export.parity import look
from psiamfcpp.geometry import overlap, to_centre
from psiamfcpp.models.arch import opened
from psiamfcpp.runtime import Engine, open_engine
from psiamfcpp.trackers.siamfcpp.procedure import Procedure, Target
from psiamfcpp.zoo import graph_names

_LEAST_OVERLAP = 0.98
# Frames between the crops on which the graphs are compared.
_EVERY = 8

Arrays = dict[str, NDArray[Any]]


def record(output: tyro.conf.Positional[Path], models: tuple[str, ...] = (), frames: int = 60) -> None:
    """Follow the demo's target and write boxes, states and answers.

    Args:
        output: the file to write.
        models: shipped models or folders of graphs; by default all shipped ones in 8 bits.
        frames: length of the clip, from the demo's first frame.
    """
    _begin()
    shots = [shot for _, shot in zip(range(frames), render(), strict=False)]
    images, truth = np.stack([shot.image for shot in shots]), np.array([shot.box for shot in shots])
    kept: Arrays = {"frames": images, "truth": truth}
    for model in models or [name for name in graph_names() if name.endswith("-int8")]:
        engine = open_engine(model, "onnx", threads=1)
        pairs = _pairs(engine, images, truth)
        kept |= {f"{model}/{name}": values for name, values in _follow(engine, images, truth).items()}
        kept[f"{model}/template"], kept[f"{model}/searches"] = pairs[0].template, np.stack([p.search for p in pairs])
        for name, answers in zip(("scores", "cells"), zip(*look(engine, pairs), strict=True), strict=True):
            kept[f"{model}/{name}"] = np.stack(answers)
        print(f"{model}: {len(images)} frames, {_scale(kept[f'{model}/boxes'], truth)}")
    np.savez(output, **kept)


def compare(expected: tyro.conf.Positional[Path], models: tuple[str, ...] = (), frames: int = 60) -> None:
    """Follow the frames of a file, and compare boxes, states and answers with those of the file.

    Args:
        expected: file that `record` wrote.
        models: models of the file; by default all.
        frames: number of frames to follow, from the first.
    """
    file = np.load(expected)
    if unknown := [model for model in models if model not in _models(file)]:
        raise UserError(f"{expected} does not hold {', '.join(unknown)}: it holds {', '.join(_models(file))}")
    _begin()
    missed = [model for model in models or _models(file) if not _agrees(file, model, frames)]
    if missed:
        sys.exit(f"overlap below {_LEAST_OVERLAP} or other states: {', '.join(missed)}")


def _begin() -> None:
    """Print the processor's name."""
    facts = machine()
    print(f"{facts['cpu']}, {' '.join(facts['flags'])}, onnxruntime {onnxruntime.__version__}", flush=True)


def _models(file: NpzFile) -> list[str]:
    return [name.removesuffix("/boxes") for name in file.files if name.endswith("/boxes")]


def _agrees(file: NpzFile, model: str, frames: int) -> bool:
    """Compare one model and print a line; tell whether it is within the limits."""
    kept = {name: file[f"{model}/{name}"] for name in ("boxes", "states", "template", "searches", "scores", "cells")}
    engine = open_engine(model, "onnx", threads=1)
    truth = file["truth"][:frames]
    found = _follow(engine, file["frames"][:frames], truth)
    shared = overlap(kept["boxes"][:frames], found["boxes"])
    same = kept["states"][:frames] == found["states"]
    pairs = [Pair(kept["template"], search) for search in kept["searches"]]
    difference = compare_answers(list(zip(kept["scores"], kept["cells"], strict=True)), look(engine, pairs))
    print(
        f"{model}: mean overlap {shared.mean():.4f}, least {shared.min():.4f}, states equal in {same.sum()} of "
        f"{len(same)} frames; {_scale(found['boxes'], truth)}; graphs on {len(pairs)} crops: {difference}",
        flush=True,
    )
    return bool(shared.mean() >= _LEAST_OVERLAP and same.all())


def _follow(engine: Engine, images: NDArray[np.uint8], truth: NDArray[np.float64]) -> Arrays:
    """Return boxes ``(N, 4)`` and states ``(N,)`` of the target that the first box shows."""
    tracker = Tracker(engine=engine)
    tracks = [tracker.init(images[0], truth[0]), *(tracker.update(image) for image in images[1:])]
    return {
        "boxes": np.array([track.box for track in tracks]),
        "states": np.array([str(track.state) for track in tracks]),
    }


def _pairs(engine: Engine, images: NDArray[np.uint8], truth: NDArray[np.float64]) -> list[Pair]:
    """Return the first template with search crops about the true places in every eighth frame."""
    spec = engine.spec
    procedure: Procedure = opened(spec.arch.procedure)
    fill, size = procedure.fill(images[0]), spec.template_size

    def crop(frame: int, side: int) -> NDArray[np.uint8]:
        return procedure.crop(images[frame], Target(*to_centre(truth[frame])), side, size, fill, None)

    return [Pair(crop(0, size), crop(frame, spec.search_size)) for frame in range(0, len(images), _EVERY)]


def _scale(boxes: NDArray[np.float64], truth: NDArray[np.float64]) -> str:
    return f"mean overlap with the truth {overlap(boxes, truth).mean():.3f}"


if __name__ == "__main__":
    try:
        tyro.extras.subcommand_cli_from_dict({"record": record, "compare": compare})
    except UserError as error:
        print(f"processors.py: {error}", file=sys.stderr)
        sys.exit(2)
