"""Upper bounds on the input amplitude of modulators and converters, computed without rendering."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import Arrivals, arrivals
from ertis_numba.simulation.effects import EFFECTS, acting
from ertis_numba.simulation.noise_frames import CREST
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["LOUD", "may_be_loud", "peak_bound"]

Floats = NDArray[np.float64]

LOUD = 0.5
"""Amplitude at which A/B renders start to include the converters: 6 dB below full scale."""
_STRENGTHENING = frozenset(each.name for each in EFFECTS.values() if not each.weakens)
_RIPPLE = 1.5  # largest factor by which spheres, or emitters away from the centre of their array, raise an echo
_NODES = 5  # frequencies at which filters are evaluated


def may_be_loud(shot: Snapshot, active: frozenset[str]) -> bool:
    """Return True if the signals may come within 6 dB of full scale for any choice of the other effects."""
    if "spreading" not in active:
        return True
    return _RIPPLE * peak_bound(shot, _STRENGTHENING) >= LOUD


def peak_bound(shot: Snapshot, active: frozenset[str]) -> float:
    """Return an upper bound on the amplitude at all microphones, from overlapping calls and crests of the noise."""
    return shot.once(("peak", active), lambda: _calls(shot, active) + _steady(shot, active))


def _calls(shot: Snapshot, active: frozenset[str]) -> float:
    """Return the highest sum of the amplitudes of overlapping calls."""
    call = shot.sensor.call
    frequency_hz = np.linspace(call.low_frequency_hz, call.high_frequency_hz, _NODES)
    found = [_changes(entry) for entry in arrivals(shot, active, frequency_hz, CostStopwatch())]
    if not found:
        return 0.0
    time_s, change = np.concatenate(found, axis=1)
    return float(np.max(np.cumsum(change[np.argsort(time_s)]), initial=0.0))


def _changes(entry: Arrivals) -> Floats:
    """Return the times at which copies of a call begin or end at any microphone, and the change of the sum then."""
    loudest = np.max(np.abs(entry.amplitude), axis=(1, 2))
    begin_s, end_s = entry.delay_s.min(axis=1), entry.delay_s.max(axis=1) + entry.lasts_s
    return np.array([[*begin_s, *end_s], [*loudest, *-loudest]])


def _steady(shot: Snapshot, active: frozenset[str]) -> float:
    """Return the peak amplitude of tones and noise."""
    bounds: list[tuple[float, float]] = [act(shot, active) for _, act in acting("loudness", active)]
    return sum(peak for peak, _ in bounds) + CREST * math.sqrt(sum(power for _, power in bounds))
