"""Prune any network by the rank of its feature maps: here a small residual one with grouped convolutions.

Run it with ``python examples/prune_any_network.py``; it needs ``pip install 'psiamfcpp[train]'``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from psiamfcpp.pruning import find_groups, plan, prune, rank, refit


class Block(nn.Module):
    """Residual block whose first convolution is grouped."""

    def __init__(self, channels: int, inner: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, inner, 3, padding=1, groups=4, bias=False)
        self.bn1 = nn.BatchNorm2d(inner)
        self.conv2 = nn.Conv2d(inner, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, channels, H, W)`` to the same shape."""
        y = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(y)) + x)


class Net(nn.Module):
    """A stem, two residual blocks whose sums tie them to the stem, and a classifier."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, 16, 3, padding=1), nn.BatchNorm2d(16), nn.ReLU())
        self.blocks = nn.Sequential(Block(16, 24), Block(16, 32))
        self.last = nn.Sequential(nn.Conv2d(16, 12, 3), nn.ReLU())
        self.classifier = nn.Linear(12, 10)

    def forward(self, x: Tensor) -> Tensor:
        """Map images ``(B, 3, H, W)`` to logits ``(B, 10)``."""
        return self.classifier(self.last(self.blocks(self.stem(x))).mean(dim=(2, 3)))


def main() -> None:
    """Rank, plan, prune, fit what is left, and say what became of it."""
    torch.manual_seed(0)
    network = Net().eval()
    # Yours would be images as the network sees them in use; a few hundred are enough for a steady order.
    images = [torch.rand(8, 3, 24, 24) for _ in range(4)]

    for group in find_groups(network, images[0]).values():
        print(group)
    ranks = rank(network, images)
    for name, group in ranks.groups.items():
        print(f"{name:16} {len(group.rank):3} filters, {group.dead} dead{', flat' if group.flat else ''}")

    half = plan(ranks, keep=dict.fromkeys(ranks.groups, 0.5))
    small = prune(network, images[0], half)
    fitted = refit(small, network, half, images)
    unseen = torch.rand(8, 3, 24, 24)
    for title, model in (("before", network), ("pruned", small), ("fitted", fitted)):
        off = (model(unseen) - network(unseen)).abs().mean()
        print(f"{title:7} {sum(p.numel() for p in model.parameters()):,} parameters, outputs off by {off:.4f}")


if __name__ == "__main__":
    main()
