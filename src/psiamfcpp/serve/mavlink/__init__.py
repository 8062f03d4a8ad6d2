"""A MAVLink camera component that tracks."""

from psiamfcpp.serve.mavlink.camera import Camera
from psiamfcpp.serve.mavlink.link import Link, open_link

__all__ = ["Camera", "Link", "open_link"]
