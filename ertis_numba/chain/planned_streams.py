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
    """Error power of the image relative to that of a stream.

    Attributes
    ----------
    noise, coherent : float
        For errors that differ between microphones, in noise and for an echo that reaches all microphones alike.
    common : float
        For errors that all microphones share, and such an echo.
    noise_share : float
        Share of noise in the power of an image of echoes.
    """

    noise: float
    coherent: float
    common: float
    noise_share: float

    def errors(self, *, whole: float, varying: float, common: float) -> ImageErrors:
        """Return the error powers of images.

        Parameters
        ----------
        whole : float
            Error power of the stream with the whole spectrum.
        varying, common : float
            Error power where the image is bright: the part that differs between microphones, and the rest.
        """
        noise = _UNLIKE * self.noise * whole
        echoes = _UNLIKE * (self.coherent * varying + self.common * common) + self.noise_share * noise
        return ImageErrors(echoes, max(echoes, noise))


@dataclass(frozen=True, slots=True)
class StreamGrid:
    """Beam grid of a stream.

    Attributes
    ----------
    n_points, n_pairs : int
        Points of the grid, and pairs of points for each direction.
    squares : float
        Sum of a beam's squared weights.
    """

    n_taps: int
    density: float
    n_points: int
    n_pairs: int
    errors: ImageErrors
    squares: float


@dataclass(frozen=True, slots=True)
class PlannedStream:
    """Stream with its interpolation.

    Attributes
    ----------
    high_hz : float
        Frequency to which the density of its beam grid is relative.
    grid : StreamGrid or None
        Beam grid; None if every direction is summed itself.
    """

    stream: SignalStream
    spectrum: StreamSpectrum
    fit: DelayFit
    high_hz: float
    grid: StreamGrid | None
    shares: ErrorShares


@dataclass(frozen=True, slots=True)
class PlannedStreams:
    """Streams of a plan.

    Attributes
    ----------
    streams : list of PlannedStream
        As in `Recipe`, without the highest power sums if these are negligible.
    n_powers : int
        Number of power sums among them.
    delays : ImageErrors
        Errors due to interpolation of delays and power sums that are left out.
    """

    streams: list[PlannedStream]
    n_powers: int
    delays: ImageErrors
