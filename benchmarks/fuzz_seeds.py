"""Small whole files of every format that is read, and how each is read: what `fuzz.py` damages."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from psiamfcpp import datasets
from psiamfcpp.datasets.attributes import read_attributes
from psiamfcpp.datasets.boxes import read_boxes
from psiamfcpp.datasets.got10k import read_labels
from psiamfcpp.evaluation.results import read_result, read_times
from psiamfcpp.evaluation.running import read_run
from psiamfcpp.images import read_image
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec


@dataclass(frozen=True)
class Seed:
    """A format: whole files, and its reader."""

    place: Path
    """where a damaged file is put"""
    contents: list[bytes]
    read: Callable[[Path], Any]


def _boxes(folder: Path) -> Seed:
    texts = [b"1,2,3,4\n5.5,6,7,8\n" * 5, "\ufeff1\t2\t3\t4\r\nNaN NaN NaN NaN\r\n".encode(), b"1 2 3 4\n" * 3]
    return Seed(folder / "a.txt", [*texts, "1,2,3,4\n".encode("utf-16")], read_boxes)


def _times(folder: Path) -> Seed:
    return Seed(folder / "a_time.txt", [b"0.1,0.2\n0.3\n", b"0.1\n" * 9], read_times)


def _labels(folder: Path) -> Seed:
    return Seed(folder / "absence.label", [b"0\n1\n0\n", b"0,1,0,8"], read_labels)


def _attributes(folder: Path) -> Seed:
    (folder / "att").mkdir()
    return Seed(folder / "att" / "a.txt", [b"1,0,0,0,0,0,0,0,0,0,1"], lambda _: read_attributes("dtb70", folder, ["a"]))


def mat(fields: dict[str, Any], name: str = "results", packed: bool = True) -> bytes:
    """Return a MATLAB file of level 5 with a struct of texts and of arrays."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    def matrix(kind: int, shape: tuple[int, ...], called: bytes, body: bytes) -> bytes:
        head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(shape)}i", *shape))
        return element(14, head + element(1, called) + body)

    def value(given: Any) -> bytes:
        if isinstance(given, str):
            return matrix(4, (1, len(given)), b"", element(16, given.encode()))
        array = np.asarray(given, "<f8")
        return matrix(6, array.shape, b"", element(9, array.tobytes(order="F")))

    names = b"".join(key.encode().ljust(8, b"\0") for key in fields)
    body = element(5, struct.pack("<i", 8)) + element(1, names) + b"".join(map(value, fields.values()))
    whole = matrix(2, (1, 1), name.encode(), body)
    if packed:
        squeezed = zlib.compress(whole)
        whole = struct.pack("<II", 15, len(squeezed)) + squeezed
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + whole


def _mat(folder: Path) -> Seed:
    fields = {"type": "rect", "res": np.arange(40.0).reshape(10, 4), "fps": [[12.5]]}
    contents = [mat(fields), mat(fields, packed=False), mat(fields, packed=False)]
    return Seed(folder / "a.mat", contents, lambda path: read_result(path, 10))


def _run(folder: Path) -> Seed:
    run = {"format": "psiamfcpp-run/1", "tracker": "a", "dataset": "dtb70", "root": "/d", "identity": {"kind": "a"}}
    text = json.dumps({**run, "threads": 1, "jobs": 1, "processor": "p"})
    return Seed(folder / "run.json", [text.encode()], lambda path: read_run(path.parent))


def _stills(folder: Path) -> Seed:
    (folder / "images").mkdir()
    (folder / "images" / "a.jpg").touch()
    table = b"image,x,y,w,h,label,source\na.jpg,1,2,3,4,car,s\na.jpg,5,6,7,8,boat,t\n"
    return Seed(folder / "boxes.csv", [table, b'\xef\xbb\xbf"image",x,y,w,h,label,source\n'], _reading("stills"))


def _reading(kind: str, up: int = 1) -> Callable[[Path], Any]:
    """Return a reader of the dataset that holds a file; what can be skipped is skipped every other time."""

    def read(path: Path) -> None:
        root = path.parents[up - 1]
        for sequence in datasets.read(kind, root, [] if path.stat().st_size % 2 else None):
            sequence.usable()

    return read


def _clips(folder: Path) -> Seed:
    _write_video(folder / "car_0.mp4", "mp4v")
    table = b"clip,frame,track,x,y,w,h\ncar_0,0,a,1,2,3,4\ncar_0,2,a,5,6,7,8\n"
    return Seed(folder / "boxes.csv", [table], _reading("clips"))


def _write_video(path: Path, codec: str) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25, (64, 48))
    for number in range(6):
        writer.write(np.full((48, 64, 3), 40 * number, np.uint8))
    writer.release()
    return path


def _coco(folder: Path) -> Seed:
    (folder / "val2017").mkdir()
    (folder / "annotations").mkdir()
    (folder / "val2017" / "1.jpg").touch()
    label = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [10, 10, 20, 20], "iscrowd": 0}
    table = {
        "images": [{"id": 1, "file_name": "1.jpg"}],
        "categories": [{"id": 1, "name": "car"}],
        "annotations": [label, {**label, "id": 2, "segmentation": [[1.5, 2.5]]}],
    }
    content = json.dumps(table).encode()
    return Seed(folder / "annotations" / "instances_val2017.json", [content], _reading("coco", 2))


def _xml(folder: Path) -> Seed:
    labels, data = (folder / part / "VID" / "val" / "a" for part in ("Annotations", "Data"))
    labels.mkdir(parents=True)
    data.mkdir(parents=True)
    (data / "000000.JPEG").touch()
    corners = "<xmax>50</xmax><xmin>10</xmin><ymax>40</ymax><ymin>20</ymin>"
    text = f"<annotation><object><trackid>0</trackid><bndbox>{corners}</bndbox></object></annotation>"
    return Seed(labels / "000000.xml", [text.encode()], _reading("imagenet-vid", 5))


def _list(folder: Path) -> Seed:
    part = folder / "train" / "GOT-10k_Train_1"
    part.mkdir(parents=True)
    for name, text in (("groundtruth.txt", "1,2,3,4\n"), ("absence.label", "0\n"), ("cover.label", "8\n")):
        (part / name).write_text(text)
    (part / "1.jpg").touch()
    return Seed(folder / "train" / "list.txt", [b"GOT-10k_Train_1\n"], _reading("got10k", 2))


def _uav(folder: Path) -> Seed:
    (folder / "anno" / "UAV20L").mkdir(parents=True)
    (folder / "data_seq" / "UAV123" / "car").mkdir(parents=True)
    (folder / "anno" / "UAV20L" / "car1.txt").write_text("1,2,3,4\n")
    (folder / "data_seq" / "UAV123" / "car" / "000001.jpg").touch()
    text = "s = {struct('name','car1','path','a\\UAV123\\car\\','startFrame',1,'endFrame',1)};"
    return Seed(folder / "configSeqs.m", [text.encode()], lambda path: datasets.BENCHMARKS["uav20l"].read(path.parent))


def _spec(folder: Path) -> Seed:
    def read(path: Path) -> None:
        from psiamfcpp.files import read_text

        ModelSpec.from_json(read_text(path, "model description")).to_json()

    return Seed(folder / "a.json", [ModelSpec(provenance={"training": []}).to_json().encode()], read)


def _ranks(folder: Path) -> Seed:
    from psiamfcpp.pruning.table import RankTable
    from psiamfcpp.recipes.plan import plan

    def read(path: Path) -> None:
        plan(RankTable.read(path), remove=0.5)

    rank = [float(k) for k in range(8)]
    group = {"rank": rank, "max": 9.0, "norm": rank, "parts": 1, "template": {"rank": rank, "max": 9.0}}
    table = {
        "format": "psiamfcpp-ranks/1",
        "images": 4,
        "search_size": 239,
        "groups": dict.fromkeys(ARCHITECTURE.groups, group),
    }
    return Seed(folder / "a.json", [json.dumps(table).encode()], read)


def _plan(folder: Path) -> Seed:
    from psiamfcpp.pruning.planning import Plan

    text = json.dumps({"format": "psiamfcpp-plan/1", "keep": {"backbone.conv1": [0, 2, 5], "neck.cls": [1]}})
    return Seed(folder / "a.json", [text.encode()], lambda path: Plan.read(path).check(ARCHITECTURE.groups))


def _looks(folder: Path) -> Seed:
    from psiamfcpp.pruning.ranking import Looked
    from psiamfcpp.pruning.record import load_looks, save_looks

    save_looks(folder / "seed.npz", "k", [{"a": Looked((np.ones((3, 4), np.float32),), (5,))}])
    return Seed(folder / "a.npz", [(folder / "seed.npz").read_bytes()], lambda path: load_looks(path, "k"))


@cache
def _network() -> Any:
    import torch

    from psiamfcpp.models import SiamFCpp

    torch.manual_seed(0)
    network = SiamFCpp(ModelSpec(widths=dict.fromkeys(ARCHITECTURE.groups, 2), search_size=239)).eval()
    with torch.no_grad():
        network.backbone.conv1.conv.weight /= 100
    return network


def _checkpoint(folder: Path) -> Seed:
    from psiamfcpp.models import load, save

    save(folder / "seed.safetensors", _network())
    return Seed(folder / "a.safetensors", [(folder / "seed.safetensors").read_bytes()], load)


def _alexnet(folder: Path) -> Seed:
    import safetensors.torch
    import torch

    from psiamfcpp.models import SiamFCpp
    from psiamfcpp.models.alexnet import init_backbone, is_alexnet

    # of the right names, but small
    tensors = {f"features.{n}.{part}": torch.ones(4) for n in (0, 3, 6, 8, 10) for part in ("weight", "bias")}
    network = SiamFCpp(ModelSpec())

    def read(path: Path) -> None:
        if is_alexnet(path):
            init_backbone(network, path)

    return Seed(folder / "a.safetensors", [safetensors.torch.save(tensors)], read)


def _official(folder: Path) -> Seed:
    import torch

    from psiamfcpp.models.official import import_official

    state = {"model_state_dict": {"module.basemodel.conv1.conv.weight": torch.ones(3, 3), "head.si": torch.ones(1)}}
    contents = []
    for packed in (True, False):
        torch.save(state, content := io.BytesIO(), _use_new_zipfile_serialization=packed)
        contents.append(content.getvalue())
    return Seed(folder / "a.pkl", contents, import_official)


def _graphs(folder: Path, suffix: str) -> Path:
    from psiamfcpp.export.files import graphs_of, write_files
    from psiamfcpp.export.graph import Ranges
    from psiamfcpp.export.layers import layers

    network = _network()
    write_files(graphs_of(network.spec, layers(network), Ranges()), folder, suffix)
    return folder


def _onnx(folder: Path) -> Seed:
    from psiamfcpp.runtime import open_engine

    content = (_graphs(folder, "onnx") / "search.onnx").read_bytes()
    return Seed(folder / "search.onnx", [content], lambda path: open_engine(str(path.parent), threads=1))


def _openvino(folder: Path) -> Seed:
    from psiamfcpp.runtime import open_engine

    content = (_graphs(folder, "openvino") / "search.xml").read_bytes()
    return Seed(folder / "search.xml", [content], lambda path: open_engine(str(path.parent), "openvino", threads=1))


def _lightfc(folder: Path) -> Seed:
    from onnx import TensorProto, helper, numpy_helper

    from psiamfcpp.models.lightfc_import import import_lightfc

    weights = [numpy_helper.from_array(np.ones((16, 3, 3, 3), np.float32), "w")]
    weights.append(numpy_helper.from_array(np.ones(16, np.float32), "b"))
    node = helper.make_node("Conv", ["image", "w", "b"], ["z"], strides=[2, 2], pads=[1, 1, 1, 1])
    graph = helper.make_graph(
        [node],
        "g",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 128, 128])],
        [helper.make_tensor_value_info("z", TensorProto.FLOAT, None)],
        weights,
    )
    content = helper.make_model(graph).SerializeToString()
    return Seed(folder / "a.onnx", [content], lambda path: import_lightfc(path, path))


def _images(folder: Path) -> Seed:
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), (32, 24))
    contents = [cv2.imencode(suffix, image)[1].tobytes() for suffix in (".png", ".jpg", ".bmp", ".tif", ".webp")]
    contents += [cv2.imencode(suffix, image.astype(np.uint16) * 50)[1].tobytes() for suffix in (".png", ".tif")]
    contents.append(cv2.imencode(".tif", image[..., 0].astype(np.float32))[1].tobytes())
    return Seed(folder / "a.png", contents, read_image)


def _video_contents() -> list[bytes]:
    kinds = (("a.mp4", "mp4v"), ("a.avi", "MJPG"), ("a.avi", "XVID"), ("a.mkv", "mp4v"))
    with tempfile.TemporaryDirectory() as folder:
        paths = [_write_video(Path(folder) / f"{number}{name}", codec) for number, (name, codec) in enumerate(kinds)]
        return [path.read_bytes() for path in paths]


def _video(folder: Path) -> Seed:
    from psiamfcpp.video.source import open_source

    def read(path: Path) -> None:
        with open_source(path) as source:
            for _ in source:
                pass

    return Seed(folder / "a.mp4", _video_contents(), read)


def _frames(folder: Path) -> Seed:
    from psiamfcpp.datasets.frames import read_frame, video_frames

    def read(path: Path) -> None:
        frames = video_frames(path)
        read_frame(frames[-1])

    return Seed(folder / "a.mp4", _video_contents(), read)


def _log(folder: Path) -> Seed:
    from psiamfcpp.training.curve import draw_curve

    row = {"step": 50, "cls": 1.0, "centerness": 1.0, "iou": 1.0}
    text = json.dumps(row) + "\n" + json.dumps({**row, "step": 100}) + "\n"
    return Seed(folder / "log.jsonl", [text.encode()], lambda path: draw_curve(path, path.with_name("curve.png")))


def _stored(folder: Path) -> Seed:
    import safetensors.numpy

    from psiamfcpp.training.options import PairOptions
    from psiamfcpp.training.stored import StoredMaps

    content = safetensors.numpy.save({"numbers": np.arange(3), "scores": np.ones((3, 4), np.float32)}, {"pairs": "a"})
    return Seed(folder / "a.safetensors", [content], lambda path: StoredMaps(path.parent, PairOptions(), 0))


SEEDS: dict[str, Callable[[Path], Seed]] = {
    "boxes": _boxes,
    "times": _times,
    "labels": _labels,
    "attributes": _attributes,
    "mat": _mat,
    "run": _run,
    "stills": _stills,
    "clips": _clips,
    "coco": _coco,
    "xml": _xml,
    "list": _list,
    "uav": _uav,
    "spec": _spec,
    "ranks": _ranks,
    "plan": _plan,
    "looks": _looks,
    "checkpoint": _checkpoint,
    "alexnet": _alexnet,
    "official": _official,
    "onnx": _onnx,
    "openvino": _openvino,
    "lightfc": _lightfc,
    "images": _images,
    "video": _video,
    "frames": _frames,
    "log": _log,
    "stored": _stored,
}
"""formats by name; each is given a folder of its own"""
