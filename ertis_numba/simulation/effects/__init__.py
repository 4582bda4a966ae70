"""Effects on the sound, one module each. `EFFECTS` lists them in the order in which they are decided and reported."""

from typing import Final

from ertis_numba.simulation.effects import (
    absorption,
    ambient_noise,
    clock_drift,
    cross_emission,
    direct_sound,
    doppler,
    emitter_directivity,
    emitter_offset,
    emitter_response,
    interference,
    microphone_directivity,
    microphone_faults,
    microphone_noise,
    microphone_spread,
    modulation,
    occlusion,
    propagation,
    spreading,
    sync_delay,
    target_size,
    walls,
)
from ertis_numba.simulation.effects._effect import AddedCalls, Effect, Sound

__all__ = ["EFFECTS", "AddedCalls", "Effect", "Sound"]

EFFECTS: Final[dict[str, Effect]] = {
    each.EFFECT.name: each.EFFECT
    for each in (
        propagation,
        spreading,
        emitter_offset,
        cross_emission,
        sync_delay,
        clock_drift,
        walls,
        occlusion,
        target_size,
        absorption,
        emitter_response,
        emitter_directivity,
        microphone_directivity,
        doppler,
        direct_sound,
        interference,
        ambient_noise,
        microphone_noise,
        microphone_spread,
        microphone_faults,
        modulation,
    )
}
