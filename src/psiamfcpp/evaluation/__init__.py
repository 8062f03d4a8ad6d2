"""One-pass evaluation and its metrics."""
