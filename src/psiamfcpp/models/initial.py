"""Initial weights of neck and head."""

from __future__ import annotations

import math

import torch
from torch import nn

from psiamfcpp.models.network import ConvBlock, SiamFCpp


def init_neck_and_head(model: SiamFCpp, seed: int = 0) -> None:
    """Random neck and head, reproducible by seed; the classifier starts at a score of 0.01 (focal loss, section 4.1).

    Where SiamFC++ draws the head's weights with a spread of 1e-4, which its many epochs outgrow, these are scaled to
    keep the signal's variance (He et al. 2015), so that a short run learns from its first steps.
    """
    generator = torch.Generator().manual_seed(seed)
    for part in (model.neck, model.head):
        for block in part.children():
            assert isinstance(block, ConvBlock)
            inputs = block.conv.weight[0].numel()
            with torch.no_grad():
                block.conv.weight.normal_(0, math.sqrt(2 / inputs), generator=generator)
                nn.init.zeros_(block.conv.bias)  # type: ignore[arg-type]
    for block, scale, shift in (
        (model.get_submodule("head.cls_score"), 1.0, -math.log(99)),
        # exp(1.2) * 8 = 27 px: about half the side that the context gives a target.
        (model.get_submodule("head.reg_offsets"), 0.3, 1.2),
    ):
        assert isinstance(block, ConvBlock) and block.bn is not None
        nn.init.constant_(block.bn.weight, scale)
        nn.init.constant_(block.bn.bias, shift)
