"""Fusion of the images of several sensors on one platform, with foreign echoes attributed to their emitters."""

from ertis_numba.fusion.direct_sound import DirectSound, DirectSoundCheck
from ertis_numba.fusion.fused import Fused
from ertis_numba.fusion.fuser import Fuser, fuse
from ertis_numba.fusion.tables import PLATFORM

__all__ = ["PLATFORM", "DirectSound", "DirectSoundCheck", "Fused", "Fuser", "fuse"]
