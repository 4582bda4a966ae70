"""When an effect matters: for each one, by how much it would change an image, and why.

A change is one of decibels at some place of the image, beside the strongest of the image at that range or beside
the weakest reflector that it shows. An estimate of None means that the scene holds nothing for the effect
to act upon.
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
"""What is asked about each effect that can be left out."""
