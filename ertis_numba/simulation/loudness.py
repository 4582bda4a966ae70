"""Upper bounds on the input amplitude of modulators and converters, computed without rendering."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import Arrivals, arrivals, effect
from ertis_numba.simulation.names import EFFECTS
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.sources import Noise, Tone
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["LOUD", "may_be_loud", "peak_bound"]

Floats = NDArray[np.float64]

LOUD = 0.5
"""Amplitude at which A/B renders start to include the converters: 6 dB below full scale."""
_WEAKENING = frozenset(
    {"occlusion", "absorption", "doppler", "emitter_response", "emitter_directivity", "microphone_directivity"}
)
_RIPPLE = 1.5  # largest factor by which spheres, or emitters away from the centre of their array, raise an echo
_NODES = 5  # frequencies at which filters are evaluated
_CREST = 4.5  # highest of some hundred thousand Gaussian numbers, relative to their RMS


def may_be_loud(shot: Snapshot, active: frozenset[str]) -> bool:
    """Return True if the signals may come within 6 dB of full scale for any choice of the other effects."""
    if "spreading" not in active:
        return True
    return _RIPPLE * peak_bound(shot, frozenset(EFFECTS) - _WEAKENING) >= LOUD


def peak_bound(shot: Snapshot, active: frozenset[str]) -> float:
    """Return an upper bound on the amplitude at all microphones, relative to full scale.

    The bound adds the full amplitudes of calls that overlap in time, and the crest of the noise.
    """
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
    lasts_s = entry.call.duration_s * (1.0 if entry.stretch is None else float(entry.stretch.max(initial=1.0)))
    if entry.emitter is not None:
        lasts_s += effect("emitter_response", "ringing_s")(entry.emitter)
    begin_s, end_s = entry.delay_s.min(axis=1), entry.delay_s.max(axis=1) + lasts_s
    return np.array([[*begin_s, *end_s], [*loudest, *-loudest]])


def _steady(shot: Snapshot, active: frozenset[str]) -> float:
    """Return the peak amplitude of tones and noise."""
    scene, dbfs = shot.scene, shot.sensor.electronics.noise_dbfs
    tones, power = 0.0, 0.0
    if "interference" in active:
        tones = sum(_near(shot, tone) for tone in scene.tones)
        power += sum(_near(shot, noise) ** 2 for noise in scene.noises)
    if "ambient_noise" in active and scene.ambient is not None:
        power += 10 ** (scene.ambient.level_dbfs / 10)
    if "microphone_noise" in active and dbfs is not None:
        power += 10 ** (dbfs / 10)
    return tones + _CREST * math.sqrt(power)


def _near(shot: Snapshot, source: Noise | Tone) -> float:
    """Return the level of a source at the nearest microphone."""
    paths = effect("interference", "way_from")(shot, source)
    return float(10 ** (source.level_db / 20) * np.max(effect("spreading")(paths)))
