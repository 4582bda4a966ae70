"""Names of beamformers, weightings and methods of acoustic maps, as publications write them."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

__all__ = ["METHOD_TITLES"]

METHOD_TITLES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "none": "no weighting",
        "delay_and_sum": "delay-and-sum",
        "dmas": "DMAS",
        "capon": "Capon",
        "coherence_factor": "coherence factor",
        "functional": "functional beamforming",
        "music": "MUSIC",
        "clean_sc": "CLEAN-SC",
        "hr_clean_sc": "HR-CLEAN-SC",
    }
)
"""Titles by the names of settings."""
