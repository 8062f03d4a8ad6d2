from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psiamfcpp.datasets.folder import read as read_folder
from psiamfcpp.errors import UserError
from psiamfcpp.geometry import Image
from psiamfcpp.trackers.nanotrack import VERSIONS, NanoTrack, nanotrack_files, open_nanotrack

onnx = pytest.importorskip("onnx", reason="the stand-in networks are made with onnx")


def save(path: Path, nodes: list[tuple[str, list[str], list[str], dict]], inputs: dict, outputs: list[str]) -> Path:
    from onnx import TensorProto, helper, numpy_helper

    made = []
    constants = []
    for kind, sources, results, attributes in nodes:
        for source in [name for name in sources if name.startswith("=")]:
            values = np.array([float(v) for v in source[1:].split()], np.float32)
            if kind == "Slice":
                values = values.astype(np.int64)
            constants.append(numpy_helper.from_array(values.reshape(-1, 1, 1) if kind != "Slice" else values, source))
        made.append(helper.make_node(kind, sources, results, **attributes))
    unique = list({tensor.name: tensor for tensor in constants}.values())
    graph = helper.make_graph(
        made,
        "stand-in",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        unique,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def make_backbone(path: Path, side: int = 255) -> Path:
    """Brightness of blocks of 16 pixels, 0..1; a last row and column is added so that 255 gives 16 blocks."""
    pool = {"kernel_shape": [16, 16], "strides": [16, 16], "pads": [0, 0, 1, 1]}
    nodes = [
        ("ReduceMean", ["input"], ["grey"], {"axes": [1]}),
        ("AveragePool", ["grey"], ["blocks"], pool),
        ("Mul", ["blocks", "=0.00392156862745098"], ["output"], {}),
    ]
    return save(path, nodes, {"input": [1, 3, side, side]}, ["output"])


def make_head(path: Path, cells: int, distance: float = 31.5) -> Path:
    """Bright blocks score high, and every cell says that the target reaches that many pixels to all sides."""
    nodes = [
        ("Slice", ["input2", "=0 0", f"={cells} {cells}", "=2 3"], ["blocks"], {}),
        ("Add", ["blocks", "=-0.7"], ["contrast"], {}),
        ("Mul", ["contrast", "=-4 4"], ["output1"], {}),
        ("Mul", ["blocks", "=0 0 0 0"], ["nothing"], {}),
        ("Add", ["nothing", f"={distance}"], ["sizes"], {}),
        # both inputs must have their published sides
        ("Slice", ["input1", "=7 7", "=8 8", "=2 3"], ["corner"], {}),
        ("Mul", ["corner", "=0"], ["zero"], {}),
        ("Add", ["sizes", "zero"], ["output2"], {}),
    ]
    return save(path, nodes, {"input1": [1, 1, 8, 8], "input2": [1, 1, 16, 16]}, ["output1", "output2"])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, dict[str, str]]:
    backbone = str(make_backbone(tmp_path / "backbone.onnx"))
    return {
        version: {"backbone": backbone, "head": str(make_head(tmp_path / f"head-{version}.onnx", constants.cells))}
        for version, constants in VERSIONS.items()
    }


def glow(cx: float, cy: float) -> Image:
    """A frame 640x480 with one round spot, brightest at its centre."""
    columns, rows = np.arange(640), np.arange(480)[:, None]
    light = np.exp(-((columns - cx) ** 2 + (rows - cy) ** 2) / (2 * 24**2))
    return np.repeat((255 * light).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("version", ["v2", "v3"])
def test_follows_a_bright_spot(files: dict[str, dict[str, str]], version: str) -> None:
    tracker = open_nanotrack(version, files[version], threads=1)
    track = tracker.init(glow(300, 200), (268, 168, 64, 64))
    assert (track.box, track.score, track.state) == ((268, 168, 64, 64), None, None)
    for step in range(1, 16):
        cx, cy = 300 + 9 * step, 200 - 6 * step
        track = tracker.update(glow(cx, cy))
        x, y, w, h = track.box
        # a cell is 16 pixels of a crop that shows the frame at about its own scale, and the window holds back
        assert abs(x + w / 2 - cx) <= 24 and abs(y + h / 2 - cy) <= 24
        assert track.score is not None and track.score > 0.7
        # the size follows what the head says, 63 pixels of a template crop that shows 64 pixels as 63.5
        assert 55 < w < 70 and w == pytest.approx(h)


def test_two_trackers_give_equal_boxes_and_a_second_target_starts_afresh(files: dict[str, dict[str, str]]) -> None:
    one, other = (open_nanotrack("v3", files["v3"], threads=1) for _ in range(2))
    one.init(glow(100, 100), (68, 68, 64, 64))
    one.update(glow(110, 100))
    for tracker in (one, other):
        tracker.init(glow(300, 200), (268, 168, 64, 64))
    assert one.update(glow(310, 205)) == other.update(glow(310, 205))


def test_the_box_stays_in_the_frame_when_the_target_leaves_it(files: dict[str, dict[str, str]]) -> None:
    tracker = open_nanotrack("v2", files["v2"], threads=1)
    tracker.init(glow(60, 200), (28, 168, 64, 64))
    for cx in (40, 20, 0, -20, -40):
        x, y, w, h = tracker.update(glow(cx, 200)).box
        assert 0 <= x + w / 2 <= 640 and 0 <= y + h / 2 <= 480
        assert w >= 10 and h >= 10


def test_identity_is_version_and_content(files: dict[str, dict[str, str]], tmp_path: Path) -> None:
    tracker = open_nanotrack("v3", files["v3"], threads=1)
    copies = {}
    for part, path in files["v3"].items():
        copies[part] = str(tmp_path / f"copy-{part}.onnx")
        Path(copies[part]).write_bytes(Path(path).read_bytes())
    assert open_nanotrack("v3", copies, threads=1).identity == tracker.identity
    make_head(Path(copies["head"]), 15, distance=30)
    assert open_nanotrack("v3", copies, threads=1).identity != tracker.identity
    assert tracker.name == "nanotrack-v3"
    assert nanotrack_files(files["v3"]) == [Path(files["v3"]["backbone"]), Path(files["v3"]["head"])]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"backbone": None}, "needs its backbone"),
        ({"head": None}, "needs its head"),
        ({"head": "/nowhere/head.onnx"}, "head /nowhere/head.onnx of nanotrack does not exist"),
        ({"neck": "x"}, "has no option 'neck'"),
    ],
)
def test_options_that_cannot_be_used(
    files: dict[str, dict[str, str]], change: dict[str, str | None], text: str
) -> None:
    options = {key: value for key, value in {**files["v3"], **change}.items() if value is not None}
    with pytest.raises(UserError, match=text):
        open_nanotrack("v3", options)


def test_files_that_do_not_belong_together_are_refused(files: dict[str, dict[str, str]], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there are v2, v3"):
        open_nanotrack("v1", files["v2"])
    with pytest.raises(UserError, match="has 16 cells and v3 has 15"):
        open_nanotrack("v3", files["v2"])
    with pytest.raises(UserError, match="no NanoTrack backbone"):
        open_nanotrack("v2", {**files["v2"], "backbone": str(make_backbone(tmp_path / "other.onnx", 224))})
    with pytest.raises(UserError, match="no NanoTrack backbone"):
        open_nanotrack("v2", {**files["v2"], "backbone": files["v2"]["head"]})
    with pytest.raises(UserError, match="not the backbone and head of one NanoTrack"):
        open_nanotrack("v2", {**files["v2"], "head": files["v2"]["backbone"]})
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no network")
    with pytest.raises(UserError, match="cannot be opened"):
        open_nanotrack("v2", {**files["v2"], "head": str(broken)})


def test_refuses_what_is_no_frame(files: dict[str, dict[str, str]]) -> None:
    tracker = open_nanotrack("v2", files["v2"], threads=1)
    with pytest.raises(UserError, match="before init"):
        tracker.update(glow(100, 100))
    with pytest.raises(UserError, match="frame is"):
        tracker.init(glow(100, 100)[..., 0], (10, 10, 20, 20))


@pytest.mark.slow
@pytest.mark.parametrize(("version", "precision", "success"), [("v2", 1.0, 0.768), ("v3", 1.0, 0.791)])
def test_the_published_networks_give_their_measured_figures(
    shared_data: Path, version: str, precision: float, success: float
) -> None:
    from psiamfcpp.evaluation.metrics import score_sequence
    from psiamfcpp.images import read_image

    peers = shared_data.parent / "weights" / "peers"
    options = {part: str(peers / f"nanotrack{version}_{part}.onnx") for part in ("backbone", "head")}
    if not all(Path(path).is_file() for path in options.values()):
        pytest.skip(f"no weights of NanoTrack at {peers}")
    (sequence,) = read_folder(shared_data / "uav" / "UAV123_10fps" / "wakeboard7")
    tracker: NanoTrack = open_nanotrack(version, options, threads=1)
    tracker.init(read_image(sequence.frames[0]), sequence.boxes[0])
    boxes = [sequence.boxes[0], *(tracker.update(read_image(path)).box for path in sequence.frames[1:])]
    scores = score_sequence(sequence.boxes, np.array(boxes))
    assert scores.figures["precision"] == pytest.approx(precision, abs=0.005)
    assert scores.figures["auc"] == pytest.approx(success, abs=0.005)
