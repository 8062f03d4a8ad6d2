"""SiamFC++ as plain modules, made from its table; widths are data, so a pruned network is the same class."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from psiamfcpp.models.arch import OPERATIONS, PIXELS, Layer, by_depth, walk
from psiamfcpp.models.siamfcpp_alexnet import ARCHITECTURE
from psiamfcpp.spec import ModelSpec

Kernels = tuple[Tensor, Tensor]
Maps = tuple[Tensor, Tensor, Tensor]

# What may follow a convolution in place of ReLU, by the name that the tables give it.
_ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "relu6": F.relu6,
    "gelu": F.gelu,
    "sigmoid": torch.sigmoid,
}


class ConvBlock(nn.Module):
    """Convolution with bias, then BatchNorm and an activation where the design has them."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int,
        stride: int = 1,
        bn: bool = True,
        relu: bool = True,
        padding: int = 0,
        groups: int = 1,
        activation: str | None = None,
    ):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups)
        self.bn = nn.BatchNorm2d(outputs) if bn else None
        self.relu = relu
        self.activation = activation

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, inputs, H, W)`` to ``(B, outputs, H', W')``."""
        if self.bn is None:
            x = self.conv(x)
        elif self.bn.training or self.bn.weight.requires_grad:
            x = self.bn(self.conv(x))
        else:
            # Frozen, BatchNorm is a part of the convolution: that saves a pass over what can be very large maps.
            conv = self.conv
            x = F.conv2d(x, *self._folded(self.bn), conv.stride, conv.padding, groups=conv.groups)
        if self.relu:
            return F.relu(x, inplace=True)
        return _ACTIVATIONS[self.activation](x) if self.activation else x

    def _folded(self, bn: nn.BatchNorm2d) -> tuple[Tensor, Tensor | None]:
        conv, mean, var = self.conv, bn.running_mean, bn.running_var
        assert mean is not None and var is not None, "the blocks' BatchNorm keeps statistics"
        return fuse_conv_bn_weights(conv.weight, conv.bias, mean, var, bn.eps, bn.weight, bn.bias)


class Part(nn.Module):
    """The layers of one part of the table, each under its own name."""

    def __init__(self, part: str, spec: ModelSpec):
        super().__init__()
        self._rows = by_depth(spec.arch.part(part))
        for row in spec.arch.part(part):
            if not OPERATIONS[row.operation].weighted:
                continue
            inputs, outputs = (spec.arch.width(name, spec.widths) for name in (row.reads[0], row.name))
            groups = inputs if row.operation == "depthwise" else 1
            how = row.kernel, row.stride, row.bn, row.relu, row.padding, groups, row.activation
            self.add_module(row.child, ConvBlock(inputs, outputs, *how))

    def walk(self, maps: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run all layers; what they read from outside the part is given by name."""
        return walk(self._rows, maps, self.run)

    def run(self, row: Layer, x: Tensor) -> Tensor:
        """Return the map that one layer makes of the map that it reads."""
        out: Tensor = self.get_submodule(row.child)(x)
        return out


class Backbone(Part):
    """AlexNet without padding: 127 pixels give a map of 6x6, 303 pixels one of 28x28."""

    def __init__(self, spec: ModelSpec):
        super().__init__("backbone", spec)
        # One module for all pools, which have the same size.
        (size,) = {row.pool for row in self._rows if row.pool}
        self.pool = nn.MaxPool2d(*size, ceil_mode=True)

    def forward(self, x: Tensor) -> Tensor:
        """Features of crops ``(B, 3, S, S)``, BGR, 0..255."""
        return self.walk({PIXELS: x})[self._rows[-1].name]

    def run(self, row: Layer, x: Tensor) -> Tensor:
        """Return the map of one layer after its pool, if it has one."""
        out: Tensor = super().run(row, x)
        return self.pool(out) if row.pool else out


class Head(Part):
    """Classification with centre-ness, and regression of the four distances to the box's sides."""

    def __init__(self, spec: ModelSpec):
        super().__init__("head", spec)
        self._stride = spec.arch.stride
        self.si = nn.Parameter(torch.tensor(1.0))
        self.bi = nn.Parameter(torch.tensor(0.0))

    def forward(self, cls: Tensor, reg: Tensor) -> Maps:
        """Logits ``(B, N, N)`` of class and centre-ness, and distances ``(B, N, N, 4)`` in pixels."""
        maps = self.walk({"cls": cls, "reg": reg})
        offsets = maps["head.reg_offsets"].float().permute(0, 2, 3, 1)
        # The clamp only stops bfloat16 or a foreign frame from overflowing: e^6 * 8 px is beyond any crop.
        distances = torch.exp(torch.clamp(self.si * offsets + self.bi, max=6.0)) * self._stride
        return maps["head.cls_score"].float().squeeze(1), maps["head.centerness"].float().squeeze(1), distances


class Network(nn.Module):
    """What files, engines and graphs need of a network: `template` once for a target, `search` for every frame."""

    backbone: Part
    """what both crops go through"""

    def __init__(self, spec: ModelSpec):
        super().__init__()
        self.spec = spec

    def features(self, x: Tensor) -> Tensor:
        """Return the backbone's features ``(B, C, H, W)`` of crops ``(B, 3, S, S)``, BGR, float 0..255."""
        raise NotImplementedError

    def kernels(self, features: Tensor) -> Any:
        """Return what `template` does, from the features on."""
        raise NotImplementedError

    def maps(self, features: Tensor, kernels: Any) -> Maps:
        """Return what the losses look at, from the features of the search crops on."""
        raise NotImplementedError

    def template(self, z: Tensor) -> tuple[Tensor, ...]:
        """Return what `search` needs of template crops ``(B, 3, Z, Z)``, BGR, float 0..255."""
        raise NotImplementedError

    def search(self, x: Tensor, kernels: Any) -> tuple[Tensor, Tensor]:
        """Return scores ``(B, N, N)`` and boxes ``(B, N, N, 4)`` of search crops ``(B, 3, S, S)``."""
        raise NotImplementedError

    def forward(self, z: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Scores and boxes of one pass through both branches: what graph tracers need."""
        return self.search(x, self.template(z))


class SiamFCpp(Network):
    """SiamFC++ (AlexNet)."""

    def __init__(self, spec: ModelSpec | None = None):
        super().__init__(spec or ModelSpec())
        self.backbone = Backbone(self.spec)
        self.neck = Part("neck", self.spec)
        self.head = Head(self.spec)

    def template(self, z: Tensor) -> Kernels:
        """Correlation kernels of template crops.

        Args:
            z: ``(B, 3, 127, 127)``, BGR, float 0..255.

        Returns:
            ``cls_kernel`` and ``reg_kernel``, each ``(B, C, 4, 4)``.
        """
        return self.kernels(self.features(z))

    def features(self, x: Tensor) -> Tensor:
        """Return the backbone's features of crops."""
        found: Tensor = self.backbone(x)
        return found

    def kernels(self, features: Tensor) -> Kernels:
        """`template`, from the backbone's features on."""
        return self._neck("cls_template", features), self._neck("reg_template", features)

    def search(self, x: Tensor, kernels: Kernels) -> tuple[Tensor, Tensor]:
        """Scores and boxes of search crops.

        Args:
            x: ``(B, 3, S, S)``, BGR, float 0..255; S of 303 gives N = 17.
            kernels: what `template` returned, for a batch of B or of 1.

        Returns:
            scores ``(B, N, N)``, 0..1: sigmoid(class) times sigmoid(centre-ness); boxes ``(B, N, N, 4)`` as
            x0, y0, x1, y1 in pixels of the crop.
        """
        cls, centerness, distances = self.maps(self.features(x), kernels)
        return torch.sigmoid(cls) * torch.sigmoid(centerness), to_boxes(distances, x.shape[-1])

    def maps(self, features: Tensor, kernels: Kernels) -> Maps:
        """What the losses need, from the backbone's features on.

        Returns:
            Class and centre-ness logits ``(B, N, N)``, distances l, t, r, b ``(B, N, N, 4)`` in pixels of the crop.
        """
        cls_kernel, reg_kernel = kernels
        cls = depthwise_correlation(self._neck("cls_search", features), cls_kernel)
        reg = depthwise_correlation(self._neck("reg_search", features), reg_kernel)
        return self.head(cls, reg)

    def _neck(self, child: str, features: Tensor) -> Tensor:
        return self.neck.run(self.spec.arch[f"neck.{child}"], features)


def depthwise_correlation(features: Tensor, kernels: Tensor) -> Tensor:
    """Correlate ``(B, C, H, W)`` with ``(B or 1, C, h, w)``, sample by sample and channel by channel."""
    return _Correlation.apply(features, kernels.expand(len(features), -1, -1, -1))


class _Correlation(torch.autograd.Function):
    """The correlation as a grouped convolution; its gradients as two more, far quicker on a CPU than PyTorch's own."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, kernels: Tensor) -> Tensor:
        ctx.save_for_backward(features, kernels)
        return _channel_by_channel(features, kernels)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        features, kernels = ctx.saved_tensors
        gradient = gradient.to(features.dtype)
        back = kernels.flip(2, 3)
        # Channels last, as the layers before have it: their BatchNorm is slow on a gradient in another order.
        by_features = _channel_by_channel(gradient, back, padding=[n - 1 for n in kernels.shape[-2:]])
        return by_features.contiguous(memory_format=torch.channels_last), _channel_by_channel(features, gradient)


def _channel_by_channel(maps: Tensor, kernels: Tensor, padding: Sequence[int] = (0, 0)) -> Tensor:
    """Each channel ``(H, W)`` of ``(B, C, H, W)`` with its own kernel ``(h, w)`` of ``(B, C, h, w)``."""
    batch, channels = maps.shape[:2]
    groups = batch * channels
    maps, kernels = maps.reshape(1, groups, *maps.shape[-2:]), kernels.reshape(groups, 1, *kernels.shape[-2:])
    out = F.conv2d(maps, kernels, padding=list(padding), groups=groups)
    return out.reshape(batch, channels, *out.shape[-2:])


def cell_grid(search_size: int, cells: int, device: torch.device | None = None) -> Tensor:
    """Pixel ``(x, y)`` of the crop at which each cell of the score map stands: ``(N, N, 2)``, row by row."""
    steps = ARCHITECTURE.stride * torch.arange(cells, device=device, dtype=torch.float32)
    line = ARCHITECTURE.first_cell(search_size, cells) + steps
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y], dim=-1)


def to_boxes(distances: Tensor, search_size: int) -> Tensor:
    """Corners ``(B, N, N, 4)`` in the crop from distances l, t, r, b of each cell, all in pixels."""
    grid = cell_grid(search_size, distances.shape[1], distances.device)
    return torch.cat([grid - distances[..., :2], grid + distances[..., 2:]], dim=-1)
