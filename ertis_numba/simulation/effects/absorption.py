"""Absorption of high frequencies by air."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry.air import absorption_db_m
from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "gain"]


def gain(shot: Snapshot, paths: Paths, emitter: Emitter, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gain ``10 ** (-α(f) (r₁ + r₂) / 20)`` with α from ISO 9613-1: (path, mic, frequency).

    The associated dispersion, about 1e-4 of the speed of sound, is neglected, as in the standard.
    """
    from_air = absorption_db_m(shot.sensor.air, frequency_hz)
    return np.asarray(10 ** (-paths.length_m[..., None] * (from_air / 20)))


def estimate(sight: Sight) -> Estimate | None:
    """Compare echoes with those through air without absorption."""
    if not len(sight.heard):
        return None
    own = sight.heard
    from_air = absorption_db_m(sight.shot.sensor.air, sight.frequency_hz)
    length_m = own.delay_s * sight.shot.speed_m_s
    after = replace(own, gain=own.gain * 10 ** (-length_m[:, None] * from_air / 20))
    longest_m = float(np.max(length_m, where=sight.reach(own.delay_s) > 0.1, initial=0.0))
    return filtered(
        sight,
        after,
        f"{longest_m:.2f} m of air absorb {from_air[0] * longest_m:.2g} dB at the lower end of the band and "
        f"{from_air[-1] * longest_m:.2g} dB at the upper end",
    )
