"""Trackers: one contract, and one function that opens any of them."""
