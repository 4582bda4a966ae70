"""Occupancy maps from the images of a platform at known poses."""

from ertis_numba.mapping.mapper import Mapper

__all__ = ["Mapper"]
