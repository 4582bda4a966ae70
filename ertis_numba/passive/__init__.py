"""Passive listening: maps of the sound that arrives from each direction, without an own call."""

from ertis_numba.passive.bands import band_edges, octave_bands
from ertis_numba.passive.camera import AcousticCamera, is_passive
from ertis_numba.passive.cross_spectrum import CrossSpectrum

__all__ = ["AcousticCamera", "CrossSpectrum", "band_edges", "is_passive", "octave_bands"]
