"""The effects by name, in the order in which they are decided and reported."""

from typing import Final

__all__ = ["ASKED_FOR", "EFFECTS", "INDISPENSABLE"]

EFFECTS: Final = {
    "propagation": "sound takes its time, to any part of a sample",
    "spreading": "amplitude falls with distance",
    "emitter_offset": "the emitter is away from the centre of the array",
    "cross_emission": "sensors hear each other's calls",
    "sync_delay": "each sensor of the SYNC chain starts later",
    "clock_drift": "sample clocks run fast or slow",
    "walls": "mirror images of emitters and targets in walls",
    "occlusion": "walls stand between",
    "target_size": "spheres have a surface, discs face somewhere",
    "absorption": "air takes the high frequencies",
    "emitter_response": "the transducer filters the call and rings",
    "emitter_directivity": "a piston sends ahead",
    "microphone_directivity": "a port hears ahead",
    "doppler": "motion shifts and stretches the call",
    "direct_sound": "microphones hear the emitter beside them",
    "interference": "tones, noise and other sonars",
    "ambient_noise": "noise from everywhere",
    "microphone_noise": "white noise of each microphone",
    "microphone_spread": "gains and delays that no calibration knows",
    "microphone_faults": "dead and stuck microphones",
    "modulation": "sigma-delta modulators make bits, converters numbers",
}
"""What each effect is."""

INDISPENSABLE: Final = {
    "propagation": "an image is made of delays",
    "modulation": "a recording holds bits or numbers",
}
"""Effects of every scene, and why."""

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
"""Effects that a scene lacks unless a key requests them, such as ``electronics.noise_dbfs``.

They are simulated even where no image shows them, because recordings hold them."""
