"""Frames in, frames and boxes out, and what is drawn between."""
