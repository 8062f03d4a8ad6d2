"""From a checkpoint to the two graphs that the runtime needs, checked against the checkpoint."""
