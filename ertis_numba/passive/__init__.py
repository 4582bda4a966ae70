"""Passive listening: maps, bearings and signals of sound that the sensor did not emit."""

from ertis_numba.passive.bands import band_edges, octave_bands
from ertis_numba.passive.beam_sound import BeamSound, heterodyned, listen_to, time_expanded
from ertis_numba.passive.bearing_tracker import BearingTracker
from ertis_numba.passive.bearings import BearingFinder, find_bearings
from ertis_numba.passive.camera import AcousticCamera
from ertis_numba.passive.cross_spectrum import CrossSpectrum
from ertis_numba.passive.heard_signals import HeardSignals
from ertis_numba.passive.sound_sources import find_sound_sources
from ertis_numba.passive.time_differences import TimeDifference, time_differences

__all__ = [
    "AcousticCamera",
    "BeamSound",
    "BearingFinder",
    "BearingTracker",
    "CrossSpectrum",
    "HeardSignals",
    "TimeDifference",
    "band_edges",
    "find_bearings",
    "find_sound_sources",
    "heterodyned",
    "listen_to",
    "octave_bands",
    "time_differences",
    "time_expanded",
]
