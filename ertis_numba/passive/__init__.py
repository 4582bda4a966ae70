"""Passive listening: maps of the sound that arrives from each direction, without an own call."""

from ertis_numba.passive.bands import band_edges, octave_bands
from ertis_numba.passive.bearings import BearingFinder, find_bearings
from ertis_numba.passive.camera import AcousticCamera, is_passive
from ertis_numba.passive.cross_spectrum import CrossSpectrum

__all__ = [
    "AcousticCamera",
    "BearingFinder",
    "CrossSpectrum",
    "band_edges",
    "find_bearings",
    "is_passive",
    "octave_bands",
]
