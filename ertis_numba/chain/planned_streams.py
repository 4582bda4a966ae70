"""Streams of a plan, with their interpolation and their errors."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from ertis_numba.chain.interpolation_fit import DelayFit
from ertis_numba.chain.stream_spectrum import StreamSpectrum
from ertis_numba.settings.beamformers import SignalStream

__all__ = ["ErrorShares", "ImageErrors", "PlannedStream", "PlannedStreams", "StreamGrid"]

_UNLIKE: Final = 2.5  # Margin for differences between images: 4 dB.


@dataclass(frozen=True, slots=True)
class ImageErrors:
    """Error powers of images: those of echoes with some noise, and the largest of any sound, usually of noise only."""

    echoes: float = 0.0
    noise: float = 0.0

    def __add__(self, other: "ImageErrors") -> "ImageErrors":
        return ImageErrors(self.echoes + other.echoes, self.noise + other.noise)


class ErrorShares(NamedTuple):
    """Error power of the image relative to that of a stream; ``noise_share`` is that of noise in images of echoes."""

    # `noise` and `coherent`: errors that differ between microphones, in noise and for an echo; `common`: shared ones.

    noise: float
    coherent: float
    common: float
    noise_share: float

    def errors(self, *, whole: float, varying: float, common: float) -> ImageErrors:
        """Return the error powers of images from those of a stream with its whole spectrum, and where it is bright."""
        noise = _UNLIKE * self.noise * whole
        echoes = _UNLIKE * (self.coherent * varying + self.common * common) + self.noise_share * noise
        return ImageErrors(echoes, max(echoes, noise))


@dataclass(frozen=True, slots=True)
class StreamGrid:
    """Beam grid of a stream: its points, pairs of points per direction, and sum of a beam's squared weights."""

    n_taps: int
    density: float
    n_points: int
    n_pairs: int
    errors: ImageErrors
    squares: float


@dataclass(frozen=True, slots=True)
class PlannedStream:
    """Stream with its interpolation; the density of its beam grid, if it has any, is relative to ``high_hz``."""

    stream: SignalStream
    spectrum: StreamSpectrum
    fit: DelayFit
    high_hz: float
    grid: StreamGrid | None
    shares: ErrorShares


@dataclass(frozen=True, slots=True)
class PlannedStreams:
    """Streams of a plan as in `Recipe`, of which ``n_powers`` are power sums; negligible ones are left out."""

    streams: list[PlannedStream]
    n_powers: int
    delays: ImageErrors
