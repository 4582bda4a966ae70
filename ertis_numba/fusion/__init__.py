"""Fusion of the images of several sensors on one platform, with foreign echoes attributed to their emitters."""

from ertis_numba.fusion.fuser import PLATFORM, Fused, Fuser, fuse

__all__ = ["PLATFORM", "Fused", "Fuser", "fuse"]
