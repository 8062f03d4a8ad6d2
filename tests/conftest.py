"""Fixtures that several test folders share, and the hook that fails a run in which an unlisted test was skipped."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import re
import sys

# Before torch is imported: the networks here are so small that threads cost more than they give.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Without bytecode, which some environments forbid, each process that a test starts compiles the package anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Workers side by side keep to a core each: engines that take all cores would spend their time waiting for each other.
if worker := os.environ.get("PYTEST_XDIST_WORKER"):
    with contextlib.suppress(AttributeError, OSError):  # not on every system
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from numpy.typing import NDArray

from psiamfcpp.demo.clip import DemoFrame, render
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

# Likewise each worker would rewrite the assertions of all tests, which takes half of the time before the first one.
sys.dont_write_bytecode = False

Image = NDArray[np.uint8]
BACKGROUND = 40

# A verdict must not depend on how fast the machine is, nor on which examples chance draws in one run.
settings.register_profile(
    "psiamfcpp", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("psiamfcpp")

# Node ids, or their beginnings, of tests that may be skipped; the rest of a line after "#" says why.
ALLOWED_SKIPS = Path(__file__).with_name("allowed_skips.txt")
# Modules that the extras of pyproject.toml install. The core lane of .ci/run has none of them.
EXTRAS = {
    **dict.fromkeys(("torch", "safetensors", "matplotlib", "onnx", "torch_pruning"), "train"),
    **dict.fromkeys(("fastapi", "starlette", "uvicorn", "websockets"), "serve"),
    **dict.fromkeys(("pymavlink", "serial"), "mavlink"),
    **dict.fromkeys(("numba", "scipy"), "dcf"),
    **dict.fromkeys(("dask", "httpx", "PIL", "psiamfcpp_weights"), "dev"),
    **{"av": "video", "jinja2": "report", "openvino": "openvino"},
}
STRICT_SKIPS = os.environ.get("PSIAMFCPP_STRICT_SKIPS") == "1"
skipped: dict[str, str] = {}


def _note_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    # an expected failure is reported as skipped too
    if report.skipped and not hasattr(report, "wasxfail"):
        skipped[report.nodeid] = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)


pytest_runtest_logreport = pytest_collectreport = _note_skip


def _missing_extra(text: str) -> str | None:
    """Why what failed with this text is skipped: a module that an extra installs is not there."""
    found = re.search(r"No module named '(\w+).*?'", text)
    extra = found and EXTRAS.get(found[1])
    return f"without the extra {extra}: {found[0]}" if found and extra else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """Skip files that import what an extra installs, where it is not installed."""
    report = yield
    if report.failed and (why := _missing_extra(str(report.longrepr))):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, why)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Skip tests that import what an extra installs, where it is not installed."""
    report = yield
    missing = call.excinfo is not None and isinstance(call.excinfo.value, ModuleNotFoundError)
    if missing and (why := _missing_extra(str(call.excinfo.value))):
        report.outcome, report.longrepr = "skipped", (str(item.path), 0, why)
    return report


def _skipped_without_leave() -> dict[str, str]:
    lines = ALLOWED_SKIPS.read_text().splitlines() if STRICT_SKIPS and skipped else []
    allowed = tuple(start for line in lines if (start := line.partition("#")[0].strip()))
    return {name: why for name, why in skipped.items() if STRICT_SKIPS and not name.startswith(allowed)}


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail the run where a test was skipped that may not be."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["skipped"] = skipped
    if _skipped_without_leave() and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take over what a worker of xdist skipped, of which files skipped as a whole are not reported otherwise."""
    skipped.update(getattr(node, "workeroutput", {}).get("skipped", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name each test that was skipped and may not be."""
    for name, why in _skipped_without_leave().items():
        terminalreporter.write_line(f"SKIPPED {name}, which {ALLOWED_SKIPS.name} does not name: {why}", red=True)


@pytest.fixture(scope="session")
def tiny_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of a narrow network with random weights: always the same, and fast."""
    import torch

    from psiamfcpp.models import SiamFCpp, save

    path = tmp_path_factory.mktemp("model") / "tiny.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 8)))
    save(path, model.eval())
    return path


@pytest.fixture(scope="session")
def make_network() -> Callable[..., Any]:
    """A narrow network whose every value is random, so that two never agree by chance; of uneven or the given widths.

    The signal keeps its strength from layer to layer, and the statistics of BatchNorm are not the identity.
    """
    import torch

    from psiamfcpp.models import SiamFCpp

    uneven = {name: 3 + number % 4 for number, name in enumerate(ARCHITECTURE.groups)}

    def make(seed: int = 0, widths: dict[str, int] | None = None, search_size: int = 303) -> SiamFCpp:
        network = SiamFCpp(ModelSpec(widths=widths or uneven, search_size=search_size))
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for name, value in network.state_dict().items():
                if name.endswith("running_var") or name.endswith("bn.weight"):
                    value.uniform_(0.5, 1.5, generator=generator)
                elif value.ndim == 4:
                    value.normal_(0, (1 / value[0].numel()) ** 0.5, generator=generator)
                elif value.is_floating_point():
                    value.normal_(0, 0.3, generator=generator)
            network.backbone.conv1.conv.weight /= 100
        return network.eval()

    return make


@pytest.fixture(scope="session")
def tiny_graphs(tiny_model: Path, tmp_path_factory: pytest.TempPathFactory, blob_frame: Callable[..., Image]) -> Path:
    """The graphs of `tiny_model`."""
    pytest.importorskip("onnx")
    from psiamfcpp.cli import main

    root = tmp_path_factory.mktemp("graphs")
    write_sequence(root / "data" / "blob", [(100, 80, 40, 30)], blob_frame)
    assert main(["export", str(tiny_model), "-o", str(root / "tiny"), "--data", f"folder:{root / 'data'}"]) == 0
    return root / "tiny"


@pytest.fixture(scope="session")
def rendered_clip() -> list[DemoFrame]:
    """The demo's clip in small, rendered once: 20 frames of 320x192."""
    return list(render(3, 20, (320, 192)))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of research data beside the repository; tests that want it are skipped where it is absent."""
    given = os.environ.get("PSIAMFCPP_SHARED")
    path = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not path.is_dir():
        pytest.skip(f"no shared research data at {path} (PSIAMFCPP_SHARED names another folder)")
    return path


@pytest.fixture
def disk_of() -> Callable[[int], AbstractContextManager[None]]:
    """A block in which no file grows beyond a number of bytes, as on a full disk."""
    resource = pytest.importorskip("resource")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


class BlobEngine:
    """An engine that finds a bright rectangle on a dim ground by looking at the pixels; see `Engine`."""

    def __init__(self) -> None:
        self.spec = ModelSpec()
        self.peak = 0.95
        """score where the blob is; with the default calibration it is the confidence too"""
        self.absent = 0.02
        """score everywhere else"""
        self.templates: list[Image] = []
        self.searches: list[Image] = []
        self.batches: list[list[int]] = []

    def template(self, crop: Image) -> int:
        self.templates.append(crop.copy())
        return len(self.templates)

    def search(self, crop: Image, kernels: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        assert 1 <= kernels <= len(self.templates)
        return self._see(crop)

    def search_many(self, crops: Image, kernels: list[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        self.batches.append(list(kernels))
        scores, boxes = zip(*(self._see(crop) for crop in crops), strict=True)
        return np.stack(scores), np.stack(boxes)

    def _see(self, crop: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        self.searches.append(crop.copy())
        size = crop.shape[0]
        cells, first = ARCHITECTURE.score_size(size), ARCHITECTURE.first_cell(size)
        line = first + ARCHITECTURE.stride * np.arange(cells, dtype=np.float32)
        x, y = np.meshgrid(line, line)
        scores = np.full((cells, cells), self.absent, np.float32)
        boxes = np.stack([x - 31, y - 31, x + 31, y + 31], axis=-1)
        seen = _measure(crop)
        if seen is not None:
            cx, cy, w, h = seen
            last = first + ARCHITECTURE.stride * (cells - 1)
            if first - ARCHITECTURE.stride / 2 <= min(cx, cy) and max(cx, cy) <= last + ARCHITECTURE.stride / 2:
                distance = np.hypot(x - cx, y - cy) / ARCHITECTURE.stride
                shape = np.exp(-(distance**2) / 4)
                scores = np.maximum(self.absent, self.peak * shape / shape.max()).astype(np.float32)
                boxes = np.zeros((cells, cells, 4), np.float32)
                boxes[:] = (cx - (w - 1) / 2, cy - (h - 1) / 2, cx + (w - 1) / 2, cy + (h - 1) / 2)
        return scores, boxes.astype(np.float32)


def _measure(crop: Image) -> tuple[float, float, float, float] | None:
    """Centre and size of the one bright rectangle, to a fraction of a pixel."""
    light = np.clip((crop[..., 0].astype(float) - 1.5 * BACKGROUND) / (255 - 1.5 * BACKGROUND), 0, 1)
    columns, rows = light.sum(axis=0), light.sum(axis=1)
    if light.sum() < 20:
        return None
    along = np.arange(len(columns))
    cx, cy = (along * columns).sum() / columns.sum(), (along * rows).sum() / rows.sum()
    return cx, cy, columns.sum() / columns.max(), rows.sum() / rows.max()


@pytest.fixture
def blob_engine(monkeypatch: pytest.MonkeyPatch) -> BlobEngine:
    """Every tracker that is built in this test runs on this engine."""
    engine = BlobEngine()

    def open_engine(
        model: str, name: str | None, threads: int | None, search_size: int | None, device: str
    ) -> BlobEngine:
        if search_size is not None:
            engine.spec = dataclasses.replace(engine.spec, search_size=search_size)
        return engine

    monkeypatch.setattr("psiamfcpp.trackers.siamfcpp.tracker.open_engine", open_engine)
    return engine


@pytest.fixture(scope="session")
def blob_frame() -> Callable[..., Image]:
    """Draws ``(x, y, w, h)``, whole pixels or not, as a bright rectangle on a dim ground; None draws the ground."""

    @functools.cache
    def ground(width: int, height: int) -> Image:
        # squares of two shades: a frame of one shade would be a lost video signal
        squares = (np.arange(height)[:, None] // 20 + np.arange(width) // 20) % 2
        return np.repeat(BACKGROUND - 6 + 12 * squares[..., None], 3, axis=2).astype(np.uint8)

    def draw(box: tuple[float, float, float, float] | None, width: int = 320, height: int = 240) -> Image:
        frame = ground(width, height).copy()
        if box is not None:
            x, y, w, h = box
            columns = np.clip(np.minimum(np.arange(width) + 1, x + w) - np.maximum(np.arange(width), x), 0, 1)
            rows = np.clip(np.minimum(np.arange(height) + 1, y + h) - np.maximum(np.arange(height), y), 0, 1)
            lit = np.ix_(np.flatnonzero(rows), np.flatnonzero(columns))
            frame[lit] = (frame[lit] + (255.0 - frame[lit]) * np.outer(rows, columns)[lit][..., None]).round()
        return frame

    return draw


@pytest.fixture
def blob_sequence(tmp_path: Path, blob_frame: Callable[..., Image]) -> Callable[..., Path]:
    """Writes ``<root>/<name>/{img/*.png, groundtruth_rect.txt}`` with a blob in the given boxes; returns the root."""

    def write(name: str, boxes: list[tuple[float, float, float, float]]) -> Path:
        write_sequence(tmp_path / "sequences" / name, boxes, blob_frame)
        return tmp_path / "sequences"

    return write


def write_sequence(folder: Path, boxes: list[tuple[float, float, float, float]], draw: Callable[..., Image]) -> None:
    """Write ``{img/*.png, groundtruth_rect.txt}`` of a blob in the given boxes."""
    (folder / "img").mkdir(parents=True)
    for number, box in enumerate(boxes, start=1):
        cv2.imwrite(str(folder / "img" / f"{number:04}.png"), draw(box))
    (folder / "groundtruth_rect.txt").write_text("".join(",".join(map(str, box)) + "\n" for box in boxes))


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A headless Chromium, driven by Playwright; without either, tests that want it are skipped."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("Chromium is not installed")
    options = "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    options += "--disable-component-update --disable-sync"
    with playwright.sync_playwright() as api:
        running = api.chromium.launch(executable_path=path, args=options.split())
        yield running
        running.close()
