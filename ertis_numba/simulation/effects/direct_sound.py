"""Direct sound from the emitter to its own microphones."""

import math
from collections.abc import Set as AbstractSet

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import Arrivals, arrived, gains, transmitter_of
from ertis_numba.simulation.effects.spreading import spreading
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.surroundings import change_db

__all__ = ["arrivals", "estimate"]


def arrivals(
    shot: Snapshot, active: AbstractSet[str], frequency_hz: NDArray[np.float64], found: list[Arrivals]
) -> list[Arrivals]:
    """Return the arrivals, and the direct sound of the own emitter, along the housing and without its directivity."""
    emitter = shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return found
    paths, (gain, _) = _direct(shot, active), gains(shot, active)
    amplitude = (10 ** (emitter.direct_sound_db / 20) * gain * spreading(paths))[..., None]
    return [*found, arrived(shot, active, shot.number, paths.length_m / shot.speed_m_s, amplitude)]


def _direct(shot: Snapshot, active: AbstractSet[str]) -> Paths:
    return without_target(transmitter_of(shot, active, shot.number), shot.receiver, shot.targets)


def estimate(sight: Sight) -> Estimate | None:
    """Compare the direct sound in the range window with the reflectors."""
    emitter = sight.shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return None
    paths = _direct(sight.shot, sight.active)
    amplitude = 10 ** (emitter.direct_sound_db / 20) * spreading(paths)[0]
    time_s, level = sight.near_field(amplitude, paths.length_m[0] / sight.shot.speed_m_s)
    over_m = sight.settings.call.duration_s * sight.shot.speed_m_s / 2
    return Estimate(
        change_db=change_db(level, sight.surroundings().at(time_s)),
        reason=f"{20 * math.log10(amplitude.mean()):.0f} dB at the microphones, ends at {over_m:.2f} m; "
        f"the image begins at {sight.settings.processing.range_m[0]:.2f} m",
    )
