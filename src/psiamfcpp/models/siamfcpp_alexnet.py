"""The table of SiamFC++ with AlexNet (Xu et al. 2020), convolutions without padding."""

from __future__ import annotations

from psiamfcpp.models.arch import PIXELS, Architecture, Layer

_C1, _C2, _C3, _C4, _C5 = (f"backbone.conv{i}" for i in range(1, 6))
_POOL = (3, 2)

# Neck groups tie the template and the search layer, since the correlation multiplies them channel by channel.
LAYERS = (
    Layer(_C1, (PIXELS,), 96, 11, stride=2, pool=_POOL, group=_C1, ablation=_C1, thaw=1.0),
    Layer(_C2, (_C1,), 256, 5, pool=_POOL, group=_C2, ablation=_C2, thaw=1.0),
    Layer(_C3, (_C2,), 384, 3, group=_C3, ablation=_C3, thaw=0.75),
    Layer(_C4, (_C3,), 384, 3, group=_C4, ablation=_C4, thaw=0.5),
    Layer(_C5, (_C4,), 256, 3, relu=False, group=_C5, ablation=_C5, thaw=0.25),
    Layer("neck.cls_template", (_C5,), 256, 3, relu=False, group="neck.cls"),
    Layer("neck.cls_search", (_C5,), 256, 3, relu=False, group="neck.cls", joined="neck.search"),
    Layer("neck.reg_template", (_C5,), 256, 3, relu=False, group="neck.reg"),
    Layer("neck.reg_search", (_C5,), 256, 3, relu=False, group="neck.reg", joined="neck.search"),
    Layer("cls", ("neck.cls_search", "neck.cls_template"), operation="correlation", joined="correlation"),
    Layer("reg", ("neck.reg_search", "neck.reg_template"), operation="correlation", joined="correlation"),
    Layer("head.cls1", ("cls",), 256, 3, bn=False, group="head.cls1", ablation="head.1"),
    Layer("head.cls2", ("head.cls1",), 256, 3, bn=False, group="head.cls2", ablation="head.2"),
    Layer("head.cls3", ("head.cls2",), 256, 3, group="head.cls3", ablation="head.3"),
    Layer("head.reg1", ("reg",), 256, 3, bn=False, group="head.reg1", ablation="head.1"),
    Layer("head.reg2", ("head.reg1",), 256, 3, bn=False, group="head.reg2", ablation="head.2"),
    Layer("head.reg3", ("head.reg2",), 256, 3, group="head.reg3", ablation="head.3"),
    Layer("head.cls_score", ("head.cls3",), 1, relu=False, joined="head.scores"),
    Layer("head.centerness", ("head.cls3",), 1, relu=False, joined="head.scores"),
    Layer("head.reg_offsets", ("head.reg3",), 4, relu=False),
)

# The paper's "pruning ratios" (section 4.1) are shares KEPT: only so do they give its 7.49 M parameters.
PAPER_KEEP = {
    _C1: 0.792,
    _C2: 0.875,
    _C3: 0.878,
    _C4: 0.870,
    _C5: 1.0,
    "neck.cls": 1.0,
    "neck.reg": 1.0,
    "head.cls1": 0.898,
    "head.cls2": 0.539,
    "head.cls3": 0.875,
    "head.reg1": 0.887,
    "head.reg2": 0.566,
    "head.reg3": 0.875,
}

ARCHITECTURE = Architecture(
    layers=LAYERS,
    network="psiamfcpp.models.network:SiamFCpp",
    exporter="psiamfcpp.export.siamfcpp",
    procedure="psiamfcpp.trackers.siamfcpp.procedure:PROCEDURE",
    objective="psiamfcpp.training.siamfcpp:OBJECTIVE",
    template_size=127,
    search_size=303,
    sizes=(239, 303),
    stride=8,
    scalars=2,  # the head's si and bi, which map its outputs to distances
    presets={"paper": PAPER_KEEP},
    rates=(
        # It multiplies grey levels of 0..255, so its weights, and the steps that suit them, are smaller.
        (r"backbone\.conv1\.conv\.weight", 1 / 57),
        # These few numbers alone set the scale of scores and boxes; at the others' rate that takes too many steps.
        (r"head\.(si|bi|(cls_score|centerness|reg_offsets)\.bn\..*)", 10.0),
    ),
)
