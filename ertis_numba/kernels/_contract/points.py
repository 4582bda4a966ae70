"""Contracts of the kernels of points, for one thread: the image of a single reflector, and interpolated maxima."""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "ABSENT",
    "N_VALUES",
    "BeamErrors",
    "Complexes",
    "Doubles",
    "EchoSamples",
    "Places",
    "PointKernels",
    "Pulse",
    "Quadrics",
    "Singles",
]

ABSENT: Final = math.log(np.finfo(np.float32).tiny)
"""Logarithm of an amplitude of 0, as of a bin that cleaning removes."""
N_ROUNDS: Final = 8
N_TRIED: Final = 3
"""Further starts that are followed: those with the least misfits."""
N_VALUES: Final = 22
N_WIDENED: Final = 3
DAMPING: Final = 1e-3
MAX_DAMPING: Final = 1e4
CONVERGED: Final = 1e-2
"""Last step, in standard deviations; larger if the misfit shows that these are too small."""
MAX_NP: Final = 100.0
"""Logarithm of an amplitude beyond those of single precision, at which a fit has diverged."""
RICE: Final = 0.5
"""The mean amplitude of an echo a in noise of the power n² is about the root of a² + n² / 2."""
MUCH: Final = 2.5
"""Misfit per degree of freedom, beyond which another minimum may fit better."""
TOO_MUCH: Final = 2.0
"""Misfit per degree of freedom, beyond which something other than a single echo and noise is in the samples."""
WIDE_RAD: Final = 0.5
"""Standard deviation of a direction that the samples do not determine."""
DARK: Final = 1e-9
LEAST_M: Final = 1e-3
TINY: Final = 1e-30

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
        The same with the spectrum weighted by the frequency relative to the carrier.
    step_m : float
        Spacing of the differences.
    carrier_1_m : float
        Wave number of the carrier.
    positions_m : (mic, axis) float64
    weights : (mic,) float64
        Array weights, with a mean of 1.
    speed_m_s : float
        Sound speed of the table.
    """

    table: Complexes
    tilted_hz: Complexes
    step_m: float
    carrier_1_m: float
    positions_m: Doubles
    weights: Doubles
    speed_m_s: float


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
    fit : (place,) int64
        Quadric of each place.
    rises : (place, neighbour) float64
        Values of the neighbours, relative to that of the direction.
    out : (place, 4) float64
        Offset of the maximum, and its rise; 0 if there is none within reach.
    """

    def __call__(self, quadrics: Quadrics, fit: Places, rises: Doubles, out: Doubles) -> None: ...


class InterpolateTops(Protocol):
    """Interpolate the maxima of the logarithm of an image by parabolas.

    Parameters
    ----------
    fit : (place,) int64
        Quadric of each place.
    logs : (place, sample) float64
        Logarithms of the amplitudes: those at the range before the maximum, of the maximum, and at the range after it;
        then those of its neighbours.
    out : (place, 5) float64
        Shift along the range in steps, offset of the direction, and logarithm of the amplitude.
    """

    def __call__(self, quadrics: Quadrics, fit: Places, logs: Doubles, out: Doubles) -> None: ...


class EchoSamples(NamedTuple):
    """Samples of an image around its maxima.

    Attributes
    ----------
    row : (place, sample) int64
        Directions; the first one is that of the maximum.
    is_used : (place, sample) bool
        False for samples that are equal to others or have no amplitude.
    amplitude : (place, sample) float64
    offset_m : (place, sample) float64
        Ranges relative to that of the maximum.
    range_m : (place,) float64
        Ranges of the maxima.
    is_coarse : (place,) bool
        True if the grid is so coarse that several echoes may explain the samples.
    """

    row: Places
    is_used: NDArray[np.bool_]
    amplitude: Doubles
    offset_m: Doubles
    range_m: Doubles
    is_coarse: NDArray[np.bool_]


class FitEchoes(Protocol):
    """Fit range, direction and amplitude of single echoes to samples of an image, weighted by their noise.

    White noise in the signals correlates the noise of neighbouring samples as the image of an echo does. Half of its
    power changes amplitudes. The errors of the model are independent. If the misfit is too large for both, the errors
    of the model are larger, and the fit is repeated with these.

    Parameters
    ----------
    pulse : Pulse
        With the tilted table.
    starts : (place, start, 4) float64
        Range offset in metres, offsets of the direction along both axes, and logarithm of the amplitude. The first one
        serves alone, unless the grid is coarse or the misfit is large.
    axes : (place, 2, axis) float64
        Axes across the direction of the maximum; the second one is 0 if the grid has one.
    noise : float
        Root mean square of the noise of the image.
    model : float
        Errors of the model relative to the amplitude.
    is_focused : bool
        True if beams assume spherical wavefronts.
    scale : float
        As for `SpreadAmplitudes`.
    out : (place, 22) float64
        The four values of the best fit, its misfit, their covariance, (4, 4), and the errors of the model. Other minima
        that fit nearly as well are part of the covariance.
    """

    def __call__(
        self,
        pulse: Pulse,
        beams: BeamErrors,
        samples: EchoSamples,
        starts: Doubles,
        axes: Doubles,
        noise: float,
        model: float,
        is_focused: bool,  # noqa: FBT001  Numba has no keywords
        scale: float,
        out: Doubles,
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PointKernels:
    """Kernels of points of one device, all for one thread."""

    spread_amplitudes: SpreadAmplitudes
    find_tops: FindTops
    interpolate_tops: InterpolateTops
    fit_echoes: FitEchoes
