"""Contracts of the kernels of points, for one thread: the image of a single reflector, and interpolated maxima."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "ABSENT",
    "ALIKE",
    "CONVERGED",
    "DARK",
    "MAX_SHIFT",
    "BeamErrors",
    "Complexes",
    "Doubles",
    "Places",
    "PointKernels",
    "Pulse",
    "Quadrics",
    "Singles",
]

ABSENT: Final = math.log(np.finfo(np.float32).tiny)
"""Logarithm of an amplitude of 0, as of a bin that cleaning removes."""
ALIKE: Final = 1.0
"""Deviation in nepers from the samples of a single reflector, beyond which there are several."""
CONVERGED: Final = 1e-5
"""Change by a correction, in range steps, in unit vectors and in nepers, below which there are no more."""
DARK: Final = 1e-6
"""Amplitude below the side lobes of any array."""
MAX_SHIFT: Final = 0.5
"""Change by all corrections, in range steps and in nepers, beyond which they have not converged."""

Complexes = NDArray[np.complex128]
Doubles = NDArray[np.float64]
Places = NDArray[np.int64]
Singles = NDArray[np.complex64]


class Pulse(NamedTuple):
    """Compressed pulse, tabulated over differences of paths, and the microphones that hear it.

    Attributes
    ----------
    table : (path,) complex128
        Pulse relative to its carrier; at negative differences, it is the complex conjugate.
    tilted_hz : (path,) complex128
        The same with the spectrum weighted by the frequency relative to the carrier; empty without errors of beams.
    step_m : float
        Spacing of the differences.
    carrier_1_m : float
        Wave number of the carrier.
    positions_m : (mic, axis) float64
    weights : (mic,) float64
        Array weights, with a mean of 1.
    """

    table: Complexes
    tilted_hz: Complexes
    step_m: float
    carrier_1_m: float
    positions_m: Doubles
    weights: Doubles


class Quadrics(NamedTuple):
    """Fits of quadrics to directions and their neighbours, over the plane or the line that contains them.

    Attributes
    ----------
    axes : (fit, 2, axis) float64
        Axes of the plane; the first one is that of the line.
    inverse : (fit, 5, neighbour) float64
        Matrix from values to the coefficients of x, y, x², xy and y².
    n_axes : (fit,) int64
        Axes along which maxima are interpolated: 2, 1 or 0.
    reach : (fit,) float64
        Distance of the farthest neighbour; 0 without a fit.
    """

    axes: Doubles
    inverse: Doubles
    n_axes: Places
    reach: Doubles


class BeamErrors(NamedTuple):
    """Directions of a grid, and the errors of their beams.

    Attributes
    ----------
    directions : (direction, axis) float64
        Unit vectors.
    gain, slope_s : (direction, mic) complex64
        Gain at each microphone at the carrier, and its change per hertz; empty without errors.
    """

    directions: Doubles
    gain: Singles
    slope_s: Singles


class SpreadAmplitudes(Protocol):
    """Compute the amplitudes of the image of a reflector, relative to that at its place.

    Parameters
    ----------
    pulse : Pulse
    direction_offset : (place, axis) float64
        Differences of unit vectors.
    offset_m : (place,) float64
        Differences of ranges.
    scale : float
        Sound speed of the table, relative to that of the image.
    out : (place,) float64
    """

    def __call__(
        self, pulse: Pulse, direction_offset: Doubles, offset_m: Doubles, scale: float, out: Doubles
    ) -> None: ...


class FindTops(Protocol):
    """Find the maxima of quadrics.

    Parameters
    ----------
    quadrics : Quadrics
    fit : (place,) int64
        Quadric of each place.
    rises : (place, neighbour) float64
        Values of the neighbours, relative to that of the direction.
    out : (place, 4) float64
        Offset of the maximum, and its rise; 0 if there is none within reach.
    """

    def __call__(self, quadrics: Quadrics, fit: Places, rises: Doubles, out: Doubles) -> None: ...


class InterpolateTops(Protocol):
    """Interpolate the maxima of the logarithm of an image, and subtract the error of this interpolation.

    The error is that for a reflector at the interpolated maximum. Maxima whose samples do not match a single reflector
    are not corrected.

    Parameters
    ----------
    pulse : Pulse
    quadrics : Quadrics
    beams : BeamErrors
    row : (place, sample) int64
        Directions of the samples: the first three are those of the maximum, at the range before, its own, and the
        range after; then its neighbours at its range.
    fit : (place,) int64
        Quadric of each place.
    logs : (place, sample) float64
        Logarithms of the amplitudes.
    offset_m : (place, sample) float64
        Ranges of the samples, relative to that of the maximum.
    step_m : float
        Spacing of ranges.
    scale : float
        As for `SpreadAmplitudes`.
    n_rounds : int
        Largest number of corrections; 0 for none.
    out : (place, 5) float64
        Shift along the range in steps, offset of the direction, and logarithm of the amplitude.
    """

    def __call__(
        self,
        pulse: Pulse,
        quadrics: Quadrics,
        beams: BeamErrors,
        row: Places,
        fit: Places,
        logs: Doubles,
        offset_m: Doubles,
        step_m: float,
        scale: float,
        n_rounds: int,
        out: Doubles,
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PointKernels:
    """Kernels of points of one device, all for one thread."""

    spread_amplitudes: SpreadAmplitudes
    find_tops: FindTops
    interpolate_tops: InterpolateTops
