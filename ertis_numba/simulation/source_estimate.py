"""Estimated change of the recorded sound of sources by one effect."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.source_paths import AnySource, SourceInScene, all_sources
from ertis_numba.simulation.sources import Sonar

__all__ = ["change_of_sources"]

Floats = NDArray[np.float64]
_ON_SOURCES = frozenset(each.name for each in EFFECTS.values() if {"views", "gain", "emission"} & {*each.places})
_INAUDIBLE = 2.0**-20  # rounding of the modulators' input
_MAX_FREQUENCIES = 64


def change_of_sources(name: str, shot: Snapshot, active: frozenset[str]) -> Estimate | None:
    """Return the greatest change by an effect of any source's sound at the array centre; None if there is none.

    The change is ``20 log10(1 + |after - before| / level)``, where the level is the higher of both. Amplitudes of paths
    are compared one by one; a delay that changes during the record turns their phases. Sound below the resolution of
    recordings does not count.
    """
    scene = shot.scene
    if name not in _ON_SOURCES or scene.effects.get("interference") is False or not EFFECTS[name].may_apply(scene):
        return None
    middle = shot.at_centre()
    pairs = zip(all_sources(middle, active - {name}), all_sources(middle, active | {name}), strict=True)
    ratio, loudest = max(((_ratio(*pair), pair[0].name) for pair in pairs), default=(0.0, ""))
    if not ratio:
        return None
    change_db = 20 * math.log10(1 + ratio)
    return Estimate(
        change_db=change_db, reason=f"the sound of {loudest} at the sensor changes by {change_db:.2f} dB", sure=1.0
    )


def _ratio(before: SourceInScene[AnySource], after: SourceInScene[AnySource]) -> float:
    """Return the change of the sound of a source relative to its level, 0 to about 1."""
    frequency_hz, power = before.spectrum
    every = -(-len(power) // _MAX_FREQUENCIES)
    frequency_hz, power = frequency_hz[::every], power[::every] * every
    (level, delays), (new_level, new_delays) = (_heard(each, frequency_hz) for each in (before, after))
    none, total, ways = np.zeros(len(frequency_hz)), np.zeros((2, len(frequency_hz))), level.keys() | new_level.keys()
    change = np.zeros(len(frequency_hz))
    for way in sorted(ways):
        one, other = level.get(way, none), new_level.get(way, none)
        change += np.abs(other - one)
        if way in delays and way in new_delays:
            apart_s = float(np.abs(np.subtract(delays[way], new_delays[way])).max())
            turn_rad = np.minimum(2 * math.pi * frequency_hz * apart_s, math.pi)
            change += 2 * np.sin(turn_rad / 2) * np.minimum(one, other)
        total += np.array([one, other]) ** 2
    reference = math.sqrt(float(np.max(total @ power)))
    return math.sqrt(float(change**2 @ power)) / max(reference, _INAUDIBLE)


def _heard(
    source: SourceInScene[AnySource], frequency_hz: Floats
) -> tuple[dict[str, Floats], dict[str, tuple[float, float]]]:
    """Return the amplitude of each path, and its delays at the beginning and at the end of the call or the record."""
    if not len(source.paths):
        return {}, {}
    response = np.abs(source.response(frequency_hz)[:, 0])
    lasts_s = (
        source.source.call.duration_s if isinstance(source.source, Sonar) else source.shot.sensor.recording.duration_s
    )
    early_s, late_s = (source.arrival(sent_s)[0][:, 0] - sent_s for sent_s in (0.0, lasts_s))
    names = source.paths.names
    return (
        dict(zip(names, response, strict=True)),
        dict(zip(names, zip(early_s.tolist(), late_s.tolist(), strict=True), strict=True)),
    )
