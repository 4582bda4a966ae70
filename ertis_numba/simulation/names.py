"""Names of the effects, in the order in which they are decided and reported."""

from typing import Final

__all__ = ["ASKED_FOR", "EFFECTS", "INDISPENSABLE"]

EFFECTS: Final = {
    "propagation": "propagation delays, including fractions of a sample",
    "spreading": "decrease of amplitude with distance",
    "emitter_offset": "offset of the emitter from the centre of the array",
    "cross_emission": "calls of the other sensors of the scene",
    "sync_delay": "later start of each sensor along the SYNC chain",
    "clock_drift": "sample clocks that run fast or slow",
    "walls": "mirror images of emitters and targets in walls",
    "occlusion": "walls that block sound paths",
    "target_size": "surfaces of spheres, and size and orientation of discs",
    "absorption": "absorption of high frequencies by air",
    "emitter_response": "frequency response and ringing of the transducer",
    "emitter_directivity": "directivity of the emitter as a circular piston",
    "microphone_directivity": "directivity of the microphone ports",
    "doppler": "shift and stretch of the call due to motion",
    "direct_sound": "direct sound from the emitter to its own microphones",
    "interference": "tones, noise and other sonars",
    "ambient_noise": "diffuse noise from all directions",
    "microphone_noise": "white noise of each microphone",
    "microphone_spread": "gains and delays that the calibration does not contain",
    "microphone_faults": "dead and stuck microphones",
    "modulation": "conversion to PDM bits or PCM samples",
}
"""Description of each effect."""

INDISPENSABLE: Final = {
    "propagation": "images are computed from delays",
    "modulation": "recordings contain bits or samples",
}
"""Effects that every scene needs, and the reason."""

ASKED_FOR: Final = frozenset(
    {
        "emitter_offset",
        "clock_drift",
        "emitter_response",
        "emitter_directivity",
        "microphone_directivity",
        "direct_sound",
        "interference",
        "ambient_noise",
        "microphone_noise",
        "microphone_spread",
        "microphone_faults",
    }
)
"""Effects that a scene has only if one of its keys requests them, such as ``electronics.noise_dbfs``.

They are simulated even if no image shows them, because recordings contain them."""
