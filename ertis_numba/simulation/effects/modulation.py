"""Conversion to PDM bits or PCM samples; `Engine` applies it."""

from typing import Final

from ertis_numba.simulation.effects._effect import Effect

__all__ = ["EFFECT"]


EFFECT: Final = Effect(
    name="modulation",
    about="conversion to PDM bits or PCM samples",
    equation="sigma-delta, see below",
    source="Schreier and Temes, 2005",
    needed_if="always",
    indispensable="recordings contain bits or samples",
)
