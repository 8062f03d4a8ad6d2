"""Time a training pair for versions of settings that take turns in one process, so that other load slows all alike.

    python benchmarks/training.py --data LAYOUT:FOLDER [LAYOUT:FOLDER ...]

Prints milliseconds of processor time a pair on one thread: first of the loader, for search crops of both sizes, then of
the whole step (forward, backward, clipping, optimizer), and what the step costs against the first version: the settings
of version 0.1. Processor time does not count what other processes do meanwhile; on a GPU it says nothing of the step.
"""

from __future__ import annotations

import contextlib
import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import torch
import tyro

from psiamfcpp import datasets
from psiamfcpp.errors import UserError
from psiamfcpp.models import load
from psiamfcpp.models.network import SiamFCpp
from psiamfcpp.training.batches import Batch, collate
from psiamfcpp.training.loop import PairLoss, bf16_pays
from psiamfcpp.training.options import LossWeights, PairOptions, TeacherOptions
from psiamfcpp.training.pairs import PairSampler
from psiamfcpp.training.stored import CELLS
from psiamfcpp.training.teacher import open_teacher

_ALL = ("conv1", "conv2", "conv3", "conv4", "conv5")


@dataclass(frozen=True)
class Version:
    """Settings of a step."""

    name: str
    search_size: int = 239
    bf16: bool = True
    free: tuple[str, ...] = _ALL
    teacher: str = ""
    """none, "live" (the network itself, as large as what a pruned one learns from) or "stored" """


_VERSIONS = (
    Version("303 px, every layer free (0.1)", 303),
    Version("303 px, float32", 303, bf16=False),
    Version("239 px, every layer free"),
    Version("239 px, without gradient of conv1 and conv2", free=_ALL[2:]),
    Version("303 px, live teacher (0.1)", 303, teacher="live"),
    Version("239 px, live teacher", teacher="live"),
    Version("239 px, stored teacher", teacher="stored"),
)


def main(
    data: tuple[str, ...],
    model: str = "siamfcpp-alexnet",
    pairs: int = 200,
    batch: int = 32,
    rounds: int = 3,
    cache_gb: float = 3.0,
) -> None:
    """Measure and print.

    Args:
        data: training sets, as for `psiamfcpp train`.
        model: network whose widths are trained; a shipped name or a checkpoint.
        pairs: pairs a round for the loader.
        batch: pairs a step.
        rounds: turns of every version.
        cache_gb: decoded images that the loader keeps, GB.
    """
    if min(pairs, batch, rounds) < 1:
        raise UserError("pairs, batch and rounds must be at least 1")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    sequences = [sequence for entry in data for sequence in datasets.read_entry(entry)]
    samplers = {
        size: PairSampler(sequences, PairOptions(search_size=size), cache_bytes=int(cache_gb * 1e9))
        for size in (303, 239)
    }
    numbers = iter(range(10**9))
    _compare(
        {
            f"loader, {size} px": lambda s=sampler: [s.pair(next(numbers)) for _ in range(pairs)]  # type: ignore[misc]
            for size, sampler in samplers.items()
        },
        rounds,
        pairs,
    )
    batches = {size: collate([sampler.pair(i) for i in range(batch)]) for size, sampler in samplers.items()}
    _compare({v.name: _step(v, model, batches[v.search_size]) for v in _VERSIONS}, rounds, batch)


def _compare(versions: dict[str, Callable[[], object]], rounds: int, pairs: int) -> None:
    """Return milliseconds of processor time per pair: the median over rounds; the first round does not count."""
    spent: dict[str, list[float]] = {name: [] for name in versions}
    for number in range(rounds + 1):
        for name, run in versions.items():
            begin = time.process_time()
            run()
            if number:
                spent[name].append((time.process_time() - begin) * 1000 / pairs)
    first = statistics.median(next(iter(spent.values())))
    for name, times in spent.items():
        middle = statistics.median(times)
        print(
            f"{name:45} {middle:7.1f} ms a pair ({min(times):.1f} to {max(times):.1f}), {first / middle:.2f}x",
            flush=True,
        )


def _step(version: Version, name: str, batch: Batch) -> Callable[[], object]:
    """Return the step of a version, on a network of its own."""
    model = _network(name, version)
    teacher = open_teacher(name, torch.device("cpu")) if version.teacher == "live" else None
    if version.teacher == "stored":
        count, size = len(batch.corners), batch.search.shape[1]
        said = torch.rand(count, CELLS, CELLS), torch.full((count,), size * 1.0), batch.corners, torch.ones(count)
        batch = dataclasses.replace(batch, said=said)
    loss = PairLoss(model, LossWeights(), teacher, TeacherOptions())
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=1e-6)

    def step() -> None:
        bf16 = version.bf16 and bf16_pays(torch.device("cpu"))
        with torch.autocast("cpu", torch.bfloat16) if bf16 else contextlib.nullcontext():
            total = loss(batch)["total"]
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
        optimizer.zero_grad()

    return step


def _network(name: str, version: Version) -> SiamFCpp:
    model = load(name).train()
    model.backbone.eval()
    for layer, module in model.backbone.named_children():
        module.requires_grad_(layer in version.free)
    return model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        print(f"training.py: {error}", file=sys.stderr)
        sys.exit(2)
