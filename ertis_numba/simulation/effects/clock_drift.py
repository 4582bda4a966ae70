"""Sample clocks that run fast or slow."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["clock_times", "estimate", "since_sync_s"]

Floats = NDArray[np.float64]


def clock_times(shot: Snapshot, number: int, delay_s: Floats, stretch: Floats | None) -> tuple[Floats, Floats | None]:
    """Return delays and stretches of an emitter's call on the clock of the receiving sensor."""
    # For drifts d and e since the SYNC, a time T before, the call arrives `T (d - e) / (1 + e) + (1 + d) τ` after the
    # receiver's clock reads T, and lasts `(1 + d) / (1 + e)` times as long. Arrays are (path, mic).
    sensors = shot.sensor, shot.scene.sensors[number]
    listener, emitter = (1e-6 * sensor.electronics.clock_drift_ppm for sensor in sensors)
    late_s = since_sync_s(shot) * (listener - emitter) / (1 + emitter)
    counted_s = (1 + listener) * delay_s + late_s
    if listener == emitter:
        return counted_s, stretch
    longer = (1 + listener) / (1 + emitter)
    return counted_s, np.full(delay_s.shape, longer) if stretch is None else longer * stretch


def since_sync_s(shot: Snapshot) -> float:
    """Return the time from the last SYNC to the start of the measurement, in seconds."""
    scene = shot.scene
    return (round(shot.time_s * scene.rate_hz) % scene.sync_every) / scene.rate_hz


def estimate(sight: Sight) -> Estimate | None:
    """Compute the shift of echoes due to drift of the sensors' clocks."""
    shot = sight.shot
    sensors = shot.scene.sensors
    heard = [shot.number, *sight.emitters(sight.active)]
    if not any(sensors[number].electronics.clock_drift_ppm for number in heard):
        return None
    worst = Estimate(change_db=0.0, reason="no echo arrives")
    for number in sight.emitters(sight.active):
        seen = sight.of_emitter(number, sight.active)
        if not len(seen):
            continue
        counted_s, _ = clock_times(shot, number, seen.delay_s[:, None], None)
        moved = replace(seen, delay_s=counted_s[:, 0])
        shift_s = moved.delay_s - seen.delay_s
        reach = np.maximum(sight.reach(seen.delay_s), sight.reach(moved.delay_s))
        _, ratio = sight.most_changed(seen, moved, sight.surroundings(), reach)
        change = 20 * math.log10(1 + ratio)
        if change >= worst.change_db:
            largest = shift_s[np.argmax(np.abs(shift_s))]
            reason = f"clock drift shifts the call of {sensors[number].name} by up to {1e9 * largest:+.3g} ns"
            worst = Estimate(change_db=change, reason=reason, sure=200.0)
    return worst
