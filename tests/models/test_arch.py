"""Tables of layers: what is derived from them, and that a second architecture is a table."""

from __future__ import annotations

import dataclasses
import json
import pickle
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from psiamfcpp.errors import UserError
from psiamfcpp.models import SiamFCpp, build, load, save
from psiamfcpp.models.arch import ARCHITECTURES, DEFAULT, PIXELS, architecture, by_depth, walk
from psiamfcpp.models.cost import count_parameters, facts
from psiamfcpp.pruning import Plan, find_groups
from psiamfcpp.pruning.models import example_inputs, groups_of, prune_model
from psiamfcpp.spec import ModelSpec

ALEXNET = architecture(DEFAULT)


@pytest.mark.parametrize(
    ("layer", "template", "search"),
    [("backbone.conv1", 29, 73), ("backbone.conv2", 12, 34), ("neck.reg_search", 4, 26), ("backbone.conv5", 6, 28)],
)
def test_sides_of_maps_after_their_pools(layer: str, template: int, search: int) -> None:
    assert (ALEXNET.side(layer, 127), ALEXNET.side(layer, 303)) == (template, search)


@pytest.mark.parametrize(("layer", "side"), [("cls", 23), ("head.cls1", 21), ("head.reg_offsets", 17)])
def test_sides_behind_the_correlation_depend_on_both_crops(layer: str, side: int) -> None:
    assert ALEXNET.side(layer, 303) == side
    assert ALEXNET.side(layer, 303, 135) == side - 1


def test_the_crops_that_layers_see() -> None:
    both, template = ("template", "search"), ("template",)
    seen = {name: views for name, views in ALEXNET.views.items() if views != ("search",)}
    assert seen == {
        **{f"backbone.conv{i}": both for i in range(1, 6)},
        "neck.cls_template": template,
        "neck.reg_template": template,
    }


def test_the_papers_nine_rows() -> None:
    assert list(ALEXNET.ablation) == [
        *(f"backbone.conv{i}" for i in range(1, 6)), "head.1", "head.2", "head.3", "everything",
    ]  # fmt: skip
    assert ALEXNET.ablation["head.2"] == ("head.cls2", "head.reg2")
    assert ALEXNET.ablation["everything"] == tuple(ALEXNET.groups) == tuple(ALEXNET.presets["paper"])


def test_without_rows_of_its_own_each_group_is_one() -> None:
    bare = dataclasses.replace(
        ALEXNET, layers=tuple(dataclasses.replace(layer, ablation=None) for layer in ALEXNET.layers)
    )
    assert bare.ablation == {**{group: (group,) for group in ALEXNET.groups}, "everything": tuple(ALEXNET.groups)}


def test_rows_of_lightfc() -> None:
    rows = architecture("lightfc").ablation
    assert list(rows) == [
        "backbone.stem",
        *(f"backbone.expand{i}" for i in range(1, 13)),
        *(f"head.{i}" for i in range(1, 5)),
        "everything",
    ]
    assert rows["head.1"] == ("head.score1", "head.size1", "head.offset1")


def test_layers_thaw_from_the_last_to_the_first() -> None:
    assert list(ALEXNET.unfreeze.items()) == [
        ("conv5", 0.25), ("conv4", 0.5), ("conv3", 0.75), ("conv2", 1.0), ("conv1", 1.0),
    ]  # fmt: skip


def test_readers_by_the_names_of_the_graphs() -> None:
    assert ALEXNET.readers["head.cls3"] == ("head.scores",)
    assert set(ALEXNET.readers["backbone.conv5"]) == {"neck.search", "neck.cls_template", "neck.reg_template"}
    # What the correlation reads is scaled by other means than a reader's weights.
    assert "neck.search" not in ALEXNET.readers


def test_a_walk_runs_branches_side_by_side() -> None:
    hidden = by_depth(layer for layer in ALEXNET.part("head") if layer.group)
    assert [layer.child for layer in hidden] == ["cls1", "reg1", "cls2", "reg2", "cls3", "reg3"]
    paths = walk(hidden, {"cls": "c", "reg": "r"}, lambda layer, read: f"{read}{layer.child[-1]}")
    assert (paths["head.cls3"], paths["head.reg2"]) == ("c123", "r12")


def test_an_unknown_architecture_is_refused_and_the_known_ones_are_named() -> None:
    with pytest.raises(UserError, match="unknown architecture 'resnet': known are siamfcpp-alexnet"):
        ModelSpec(architecture="resnet")
    for wrong in ("resnet", ["siamfcpp-alexnet"]):
        with pytest.raises(UserError, match=r"architecture|damaged"):
            ModelSpec.from_json(json.dumps({**json.loads(ModelSpec().to_json()), "architecture": wrong}))


def test_files_of_the_first_architecture_are_those_of_version_0_1() -> None:
    data = json.loads(ModelSpec().to_json())
    assert set(data) == {
        "format", "widths", "template_size", "search_size", "constants", "calibration", "provenance",
    }  # fmt: skip
    assert ModelSpec.from_json(json.dumps(data)).architecture == DEFAULT


SHALLOW = "siamfcpp-shallow"


@pytest.fixture
def shallow(monkeypatch: pytest.MonkeyPatch) -> ModelSpec:
    """A narrow network of an architecture of its own: AlexNet without conv4, and another template crop."""
    layers = tuple(
        dataclasses.replace(layer, reads=("backbone.conv3",)) if layer.name == "backbone.conv5" else layer
        for layer in ALEXNET.layers
        if layer.name != "backbone.conv4"
    )
    module = types.ModuleType("shallow_table")
    module.ARCHITECTURE = dataclasses.replace(  # type: ignore[attr-defined]
        ALEXNET, layers=layers, template_size=119, search_size=239, sizes=(231, 239), presets={}
    )
    monkeypatch.setitem(sys.modules, "shallow_table", module)
    monkeypatch.setitem(ARCHITECTURES, SHALLOW, "shallow_table")
    widths = {name: 4 + number % 3 for number, name in enumerate(architecture(SHALLOW).groups)}
    return ModelSpec(widths, 119, 239, architecture=SHALLOW)


def randomized(spec: ModelSpec) -> SiamFCpp:
    torch.manual_seed(0)
    network = build(spec).eval()
    with torch.no_grad():
        network.get_submodule("head.cls_score").bn.weight *= 3  # type: ignore[union-attr,operator]
    return network


def test_a_second_architecture_is_a_table(shallow: ModelSpec, tmp_path: Path) -> None:
    assert "backbone.conv4" not in shallow.widths and len(shallow.widths) == 12
    with pytest.raises(UserError, match=r"need the 12 groups; missing \[\], unknown \['backbone.conv4'\]"):
        dataclasses.replace(shallow, widths={**shallow.widths, "backbone.conv4": 4})
    with pytest.raises(UserError, match="search size 240 is not 119 plus a multiple of 8: try 231 or 239"):
        dataclasses.replace(shallow, search_size=240)
    network = randomized(shallow)
    path = tmp_path / "shallow.safetensors"
    save(path, network)
    again = load(path)
    assert again.spec == shallow
    z, x = example_inputs(shallow)
    assert again.backbone(x).shape[-1] == shallow.arch.feature_size(239) == 22
    scores, boxes = again(z, x)
    cells = shallow.arch.score_size(239)
    assert (scores.shape, boxes.shape) == ((1, cells, cells), (1, cells, cells, 4))
    assert facts(shallow)["parameters"] == count_parameters(network)
    found = {tuple(b.removesuffix(".conv") for b in g.blocks) for g in find_groups(network, (z, x)).values()}
    assert found == {group.blocks for group in groups_of(shallow).values()}
    pruned = prune_model(again, Plan({"backbone.conv3": [0, 2], "head.reg1": [1]}))
    assert pruned.spec.architecture == SHALLOW and pruned.spec.widths["backbone.conv3"] == 2


@pytest.mark.parametrize("engine", ["onnx", "openvino"])
@pytest.mark.slow
def test_a_second_architecture_is_exported_and_run_by_its_table(
    shallow: ModelSpec, tmp_path: Path, engine: str
) -> None:
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime" if engine == "onnx" else engine)
    from psiamfcpp.export.crops import rendered
    from psiamfcpp.export.files import write_graphs
    from psiamfcpp.export.graph import Ranges
    from psiamfcpp.runtime import open_engine

    network = randomized(shallow)
    # Floats are checked against torch while they are written.
    write_graphs(network, tmp_path / "graphs", "onnx", Ranges(), rendered(shallow, 2))
    opened = open_engine(str(tmp_path / "graphs"), engine)
    assert opened.spec == shallow
    assert opened.template(rendered(shallow, 1)[0].template)[0].shape[-1] == shallow.arch.side("neck.cls_search", 119)


@pytest.mark.slow
def test_a_first_kernel_of_any_odd_side_has_an_8_bit_form(monkeypatch: pytest.MonkeyPatch) -> None:
    onnx = pytest.importorskip("onnx")
    from psiamfcpp.export.crops import rendered
    from psiamfcpp.export.graph import Ranges, search_graph
    from psiamfcpp.export.layers import layers
    from psiamfcpp.export.quantize import measure, without
    from psiamfcpp.runtime.onnx_engine import open_session

    table = tuple(
        dataclasses.replace(layer, kernel=7) if layer.name == "backbone.conv1" else layer for layer in ALEXNET.layers
    )
    module = types.ModuleType("seven_table")
    module.ARCHITECTURE = dataclasses.replace(  # type: ignore[attr-defined]
        ALEXNET, layers=table, template_size=123, sizes=(187,)
    )
    monkeypatch.setitem(sys.modules, "seven_table", module)
    monkeypatch.setitem(ARCHITECTURES, "seven", "seven_table")
    spec = ModelSpec({name: 4 for name in architecture("seven").groups}, search_size=187, architecture="seven")
    with pytest.raises(UserError, match=r"crops of 123 pixels leave a rest in the pool of backbone\.conv2: try 187"):
        dataclasses.replace(spec.arch, layers=ALEXNET.layers).score_size(187)
    network, pairs = randomized(spec), rendered(spec, 1)
    ranges = measure(spec, layers(network), pairs)
    first = without(ranges, set(ranges.inputs) - {"backbone.conv1"})
    side = spec.arch.side("neck.cls_template", 123)
    kernels = {name: np.ones((1, 4, side, side), np.float32) for name in ("cls_kernel", "reg_kernel")}
    maps = []
    for some in (first, Ranges(factors=first.factors)):
        graph = search_graph(spec, layers(network), some)
        graph.graph.output.append(onnx.helper.make_tensor_value_info("backbone.conv2", onnx.TensorProto.FLOAT, None))
        session = open_session(graph.SerializeToString(), 1, 187)
        maps += session.run(["backbone.conv2"], {"crop": pairs[0].search[None], **kernels})
    found, wanted = maps
    assert np.abs(found - wanted).max() < 0.05 * np.ptp(wanted)
    assert np.ptp(wanted) > 0


def test_layers_of_any_architecture_can_be_thawed(shallow: ModelSpec) -> None:
    from psiamfcpp.training.options import Schedule

    assert Schedule(unfreeze=dict(shallow.arch.unfreeze)).free(0) == frozenset()
    with pytest.raises(UserError, match="layers are conv1, conv2"):
        Schedule(unfreeze={"conv9": 0.5})


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_tables_travel_to_other_processes(name: str) -> None:
    again = pickle.loads(pickle.dumps(architecture(name)))
    assert (again.layers, again.groups, again.sizes) == (
        architecture(name).layers,
        architecture(name).groups,
        architecture(name).sizes,
    )


def test_pixels_are_what_the_first_layer_reads() -> None:
    assert [layer.name for layer in ALEXNET.layers if PIXELS in layer.reads] == ["backbone.conv1"]
    assert ALEXNET.width(PIXELS, {}) == 3 and ALEXNET.side(PIXELS, 77) == 77
