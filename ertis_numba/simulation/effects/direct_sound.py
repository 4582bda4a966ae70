"""Direct sound from the emitter to its own microphones."""

import math
from collections.abc import Set as AbstractSet
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import transmitter_of
from ertis_numba.simulation.effects._effect import AddedCalls, Effect
from ertis_numba.simulation.effects.propagation import propagation
from ertis_numba.simulation.effects.spreading import spreading
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.sight import Sight, change_db
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose

__all__ = ["EFFECT", "direct_sound"]


def direct_sound(shot: Snapshot, transmitter: TransmitterPose) -> Paths:
    """Return the direct path from the sensor's own emitter to its microphones.

    Its level is a separate setting, ``direct_sound_db``. The sound travels along the housing, so the emitter's
    directivity does not apply.
    """
    return without_target(transmitter, shot.receiver, shot.targets)


def _calls(shot: Snapshot, active: AbstractSet[str], gain: NDArray[np.float64]) -> list[AddedCalls]:
    emitter = shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return []
    paths = direct_sound(shot, transmitter_of(shot, active, shot.number))
    amplitude = float(10 ** (emitter.direct_sound_db / 20)) * gain * spreading(paths)
    delay_s = propagation(paths, shot.speed_m_s)
    return [AddedCalls(call=shot.sensor.call, delay_s=delay_s, amplitude=amplitude[..., None], sensor=shot.number)]


def _estimate(sight: Sight) -> Estimate | None:
    """Compare the direct sound in the range window with the reflectors."""
    emitter = sight.shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return None
    paths = direct_sound(sight.shot, transmitter_of(sight.shot, sight.active, sight.shot.number))
    amplitude = 10 ** (emitter.direct_sound_db / 20) * spreading(paths)[0]
    time_s, level = sight.near_field(amplitude, paths.length_m[0] / sight.shot.speed_m_s)
    over_m = sight.settings.call.duration_s * sight.shot.speed_m_s / 2
    return Estimate(
        change_db=change_db(level, sight.beside(time_s)),
        reason=f"{20 * math.log10(amplitude.mean()):.0f} dB at the microphones, ends at {over_m:.2f} m; "
        f"the image begins at {sight.settings.processing.range_m[0]:.2f} m",
    )


EFFECT: Final = Effect(
    name="direct_sound",
    about="direct sound from the emitter to its own microphones",
    equation="level / distance",
    needed_if="the window begins before the sound ends",
    requested=True,
    estimate=_estimate,
    calls=_calls,
)
