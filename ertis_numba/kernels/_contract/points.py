"""Contracts of the kernels of points, for one thread: images of reflectors, interpolated maxima, and 8-bit levels."""

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
    """Compressed pulse, tabulated over differences of paths, and the microphones (mic,) that hear it.

    ``table`` (path,) is relative to the carrier, and conjugate at negative differences; ``tilted_hz`` is the same with
    the spectrum weighted by the frequency relative to the carrier, whose wave number is ``carrier_1_m``. Array weights
    have a mean of 1; ``speed_m_s`` is that of the table.
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

    ``axes`` (fit, 2, axis), the first of which is that of the line; ``inverse`` (fit, 5, neighbour) from values to the
    coefficients of x, y, x², xy and y²; ``n_axes`` along which maxima are interpolated, 2, 1 or 0; ``reach``, the
    distance of the farthest neighbour, 0 without a fit.
    """

    axes: Doubles
    inverse: Doubles
    n_axes: Places
    reach: Doubles


class BeamErrors(NamedTuple):
    """Directions of a grid, and gain (direction, mic) and its slope of their beams at the carrier; empty for none."""

    directions: Doubles
    gain: Singles
    slope_s: Singles


class SpreadAmplitudes(Protocol):
    """Compute the amplitudes (place,) of a reflector's image from differences of paths: (place, mic) float64."""

    def __call__(self, pulse: Pulse, path_m: Doubles, out: Doubles) -> None: ...


class FindTops(Protocol):
    """Compute the offset of the maximum of each place's quadric, and its rise: (place, 4), 0 for none within reach."""

    def __call__(self, quadrics: Quadrics, fit: Places, rises: Doubles, out: Doubles) -> None: ...


class InterpolateTops(Protocol):
    """Interpolate the maxima of the logarithm of an image by parabolas.

    ``logs`` (place, sample): at the range before the maximum, at the maximum, and at the range after it; then those of
    its neighbours. ``out`` (place, 5): shift along the range in steps, offset of the direction, logarithm of the
    amplitude.
    """

    def __call__(self, quadrics: Quadrics, fit: Places, logs: Doubles, out: Doubles) -> None: ...


class EchoSamples(NamedTuple):
    """Samples (place, sample) of an image around its maxima; the first ``row`` is the direction of the maximum.

    ``is_used`` is False for samples that are equal to others or have no amplitude. ``offset_m`` is relative to the
    range of the maximum. With ``is_coarse``, several echoes may explain the samples. The spectrum of an echo is
    that of the pulse times 1 + ``tilt_s`` times the frequency relative to the carrier.
    """

    row: Places
    is_used: NDArray[np.bool_]
    amplitude: Doubles
    offset_m: Doubles
    range_m: Doubles
    is_coarse: NDArray[np.bool_]
    tilt_s: Doubles


class FitEchoes(Protocol):
    """Fit range, direction and amplitude of single echoes to samples of an image, weighted by their noise.

    White noise in the signals correlates the noise of neighbouring samples as the image of an echo does. Half of its
    power changes amplitudes. The errors of the model, relative to the amplitude, are independent. If the misfit is too
    large for both, the errors of the model are larger, and the fit is repeated with these. ``starts`` (place, start,
    4): range offset in m, offsets along both ``axes`` across the direction, and logarithm of the amplitude; the first
    one serves alone, unless the grid is coarse or the misfit is large. ``noise`` is the RMS of the image, and
    ``is_focused`` is True for spherical wavefronts. ``out`` (place, 22): the four values of the best fit, its misfit,
    their covariance, and the errors of the model. Other minima that fit nearly as well widen the covariance.
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


class NoiseAround(Protocol):
    """Compute the highest quantile of amplitudes in windows around bins: ``out`` (quantile, bin) float32.

    ``amplitude`` (direction, range) continues as a mirror image at its ends. A window has ``n_around`` ranges from
    ``first`` (window,) on, relative to the range ``place`` (bin,). Quantiles above 0.5 exclude the slopes of a bin's
    own echo: ranges up to which amplitudes fall on each side, if they fall below ``fallen`` relative to the bin. Slopes
    of noise do not.
    """

    def __call__(
        self,
        amplitude: NDArray[np.float32],
        direction: Places,
        place: Places,
        first: Places,
        n_around: int,
        quantiles: Doubles,
        fallen: np.float32,
        out: NDArray[np.float32],
    ) -> None: ...


class EncodeLevels(Protocol):
    """Round levels to codes: ``out = 1 + (log2(amplitude) - floor) * per_octave``, at least 0 and at most 255.

    ``bits`` (place,) int32 are those of the amplitudes in single precision. Zeros have the code 0; negative numbers,
    infinity and NaN have 255.
    """

    def __call__(
        self, bits: NDArray[np.int32], floor: np.float32, per_octave: np.float32, out: NDArray[np.uint8]
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PointKernels:
    """Kernels of points of one device, all for one thread."""

    spread_amplitudes: SpreadAmplitudes
    find_tops: FindTops
    interpolate_tops: InterpolateTops
    fit_echoes: FitEchoes
    noise_around: NoiseAround
    encode_levels: EncodeLevels
