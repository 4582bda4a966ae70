"""Table of the estimates: the change of an image by each effect, and the reason.

A change is the greatest change of any point of the image in decibels. It is relative to the strongest amplitude at that
range, but at least to the weakest reflector that the image shows. An estimate of None means that nothing in the scene
is subject to the effect.
"""

from collections.abc import Callable
from typing import Final

from ertis_numba.simulation import path_needs, sound_needs
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.sight import Sight

__all__ = ["ESTIMATES", "Estimate"]

ESTIMATES: Final[dict[str, Callable[[Sight], Estimate | None]]] = {
    "spreading": path_needs.spreading,
    "emitter_offset": path_needs.emitter_offset,
    "walls": path_needs.walls,
    "occlusion": path_needs.occlusion,
    "target_size": path_needs.target_size,
    "absorption": path_needs.absorption,
    "emitter_response": path_needs.emitter_response,
    "emitter_directivity": path_needs.emitter_directivity,
    "microphone_directivity": path_needs.microphone_directivity,
    "doppler": path_needs.doppler,
    "cross_emission": sound_needs.cross_emission,
    "sync_delay": sound_needs.sync_delay,
    "clock_drift": path_needs.clock_drift,
    "direct_sound": sound_needs.direct_sound,
    "interference": sound_needs.interference,
    "ambient_noise": sound_needs.ambient_noise,
    "microphone_noise": sound_needs.microphone_noise,
    "microphone_spread": sound_needs.microphone_spread,
    "microphone_faults": sound_needs.microphone_faults,
}
"""Estimate of each effect that can be left out."""
