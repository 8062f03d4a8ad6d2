"""Training: pairs, augmentation, targets, losses, loop."""
