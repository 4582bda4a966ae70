"""Recipes: streams of a beamformer and a weighting, and the numbers that combine their sums."""

from typing import Final, NamedTuple, Protocol

from ertis_numba.settings import Processing
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS, SignalStream

__all__ = ["LINEAR", "Recipe", "recipe_of", "uses_streams"]

LINEAR: Final = SignalStream(1.0, 1)
"""Stream of the signals themselves, to which a filter can apply gains."""


class Recipe(NamedTuple):
    """Streams of a beamformer and a weighting: power sums, then those of the coherence factor; −1 for none."""

    streams: tuple[SignalStream, ...]
    order: int
    beam: int
    total: int


def recipe_of(processing: Processing) -> Recipe | None:
    """Return the streams of processing settings; None if only a kernel for all microphones can compute them."""
    beamformer = BEAMFORMERS[processing.beamformer]
    streams = beamformer.streams(*beamformer.values(processing))
    weighting = WEIGHTINGS[processing.weighting]
    if not streams or (weighting.kernel and not weighting.streams):
        return None
    added = weighting.streams
    whole = streams + tuple(stream for stream in added if stream not in streams)
    beam, total = (whole.index(stream) for stream in added) if added else (-1, -1)
    return Recipe(whole, len(streams), beam, total)


class _Plan(Protocol):
    """Accuracy settings, or a plan that has a value for each of these."""

    @property
    def precision(self) -> str: ...
    @property
    def delay_taps(self) -> int | None: ...
    @property
    def beam_taps(self) -> int | None: ...


def uses_streams(processing: Processing, accuracy: _Plan) -> bool:
    """Return True if a complete plan computes an adaptive beamformer from streams, not from all microphones at once."""
    plan = accuracy.precision, accuracy.delay_taps or 1, accuracy.beam_taps or 0
    return processing.is_adaptive and recipe_of(processing) is not None and plan != ("float32", 1, 0)
