"""Delay-and-sum beamforming of analytic signals."""

import math
from typing import Any, Final, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.beam_grid import Aperture
from ertis_numba.chain.beamform import BeamformFloat32
from ertis_numba.chain.delays import DelayTable, Zone
from ertis_numba.chain.focal_zones import NEAREST_M, zone_edges
from ertis_numba.chain.interpolation_fit import WAVES, DelayFit, Spectrum, one_thread
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry import air, unit_vectors
from ertis_numba.pipeline.arrays._device import band_of, numbers_of, on_device, require_no_integers
from ertis_numba.settings import MAX_SPAN_M, Air

__all__ = ["beamform"]

_DELAY_TAPS: Final = 4
_DELAY_ERROR_DB: Final = -80.0
_PHASES: Final = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_BAND_THRESHOLD: Final = 0.03  # relative to the maximum of the spectrum, -30 dB
_ZONE_PHASE_RAD: Final = 3e-3  # largest phase error within a focal zone, -50 dB of a channel
_DIRECTIONS_AT_A_TIME: Final = 4096


_MAX_STEP_ERROR: Final = 1e-6  # relative to the spacing of ranges


def beamform(
    signals: ArrayLike,
    positions_m: ArrayLike,
    directions_rad: ArrayLike,
    *,
    sample_rate_hz: float,
    ranges_m: ArrayLike,
    sound_speed_m_s: float | None = None,
    band_hz: tuple[float, float] | None = None,
    weights: ArrayLike | None = None,
    delay_s: ArrayLike | None = None,
    wavefront: Literal["plane", "spherical"] = "plane",
    device: str = "auto",
    threads: int | None = None,
) -> NDArray[np.float32]:
    """Delay and sum signals, and return the envelope of each beam at each range.

    Range r is the echo time 2 r / c, counted from sample 0, at which the emission begins. For a plane wave from the
    unit vector u, the microphone at p has the delay -p · u / c. Delays between samples are interpolated with an error
    below -80 dB of a channel.

    Parameters
    ----------
    signals : (mic, sample) complex or float
        Analytic signals, such as those of `matched_filter`. Real signals are made analytic, as by
        `scipy.signal.hilbert`.
    positions_m : (mic, 3) float
        Microphone positions x, y, z in metres; ranges count from the origin.
    directions_rad : (direction, 2) float
        Azimuth and elevation in radians: x is azimuth 0, y is azimuth π/2, and z is elevation π/2.
    sample_rate_hz : float
        Rate of the signals in hertz.
    ranges_m : (range,) float
        Ranges in metres, ascending and evenly spaced.
    sound_speed_m_s : float, optional
        Speed of sound; by default that of air at 20 °C and 50 % relative humidity.
    band_hz : (low, high), optional
        Band of the signals in hertz. By default, the frequencies at which their mean spectrum is less than 30 dB below
        its maximum.
    weights : (mic,) float, optional
        Array weights, not below 0; uniform by default. They are scaled to a mean of 1.
    delay_s : (mic,) float, optional
        Additional delay of each microphone in seconds, 0 by default.
    wavefront : {"plane", "spherical"}
        Shape of the echo's wavefront; ``spherical`` focuses on each range.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device, as for `Pipeline`.
    threads : int, optional
        Number of threads; all cores by default.

    Returns
    -------
    (direction, range) float32
        Envelope of the mean over the microphones.

    Raises
    ------
    ArgumentError
        An argument has another type, shape or range than listed above.
    DeviceError
        The device is not available.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> pulse = np.exp(-(((np.arange(2000) - 1000) / 20) ** 2) + 2j * np.pi * np.arange(2000) / 12)
    >>> image = ertis.beamform(
    ...     np.tile(pulse, (4, 1)),
    ...     positions_m=[[0, y, 0] for y in (-6e-3, -2e-3, 2e-3, 6e-3)],
    ...     directions_rad=np.radians([[-30, 0], [0, 0], [30, 0]]),
    ...     sample_rate_hz=450e3,
    ...     ranges_m=np.arange(0.3, 0.5, 0.001),
    ... )
    >>> image.shape, int(image.max(axis=1).argmax())
    ((3, 200), 1)
    """
    rate_hz = checks.between("sample_rate_hz", sample_rate_hz, 1e3, 1e9)
    speed_m_s = (
        air.sound_speed_m_s(Air()) if sound_speed_m_s is None else checks.positive("sound_speed_m_s", sound_speed_m_s)
    )
    checks.choice("wavefront", wavefront, ("plane", "spherical"))
    given = np.asarray(signals)
    if given.ndim != 2 or given.dtype.kind not in "cfiu" or not given.size:
        raise ArgumentError(
            f"signals holds {given.dtype} of shape {given.shape}; pass real or complex numbers of shape (mic, sample)"
        )
    require_no_integers("signals", given)
    checks.finite_array("signals", given)
    angles_rad = directions_of(directions_rad)
    range_m, step_m = ranges_of(ranges_m)
    places_m = places_of(positions_m, len(given), float(range_m[-1]) if wavefront == "plane" else math.inf)
    record_m = speed_m_s * given.shape[1] / rate_hz / 2
    if range_m[-1] > record_m:
        raise ArgumentError(
            f"ranges_m ends at {range_m[-1]:g} m, but signals of {1e3 * given.shape[1] / rate_hz:.4g} ms reach "
            f"{record_m:.4g} m; use smaller ranges or longer signals"
        )
    own_s = np.zeros(len(given)) if delay_s is None else numbers_of("delay_s", delay_s, (len(given),))
    amplitudes = weights_of(weights, len(given))
    spectra, spacing_hz = _one_sided(given, rate_hz)
    low_hz, high_hz = _occupied(spectra, spacing_hz) if band_hz is None else band_of("band_hz", band_hz, rate_hz)
    output_rate_hz = speed_m_s / (2 * step_m)
    spectrum = Spectrum(np.linspace(low_hz, high_hz, WAVES), np.full(WAVES, 1 / WAVES))
    aperture = Aperture.of(places_m, unit_vectors(angles_rad[:, 0], angles_rad[:, 1]))
    with one_thread():
        fit, n_phases = _delay_fit(output_rate_hz, spectrum)
        edges = [(0, len(range_m), math.inf)]
        if wavefront == "spherical":
            edges = zone_edges(range_m, _zone_count(aperture, range_m, high_hz / speed_m_s))
        reach_s = np.linalg.norm(places_m, axis=1).max() / speed_m_s + np.abs(own_s).max()
        lead = math.ceil(reach_s * output_rate_hz) + fit.n_taps + 1
        start_s = 2 * range_m[0] / speed_m_s - lead / output_rate_hz
        frequency_hz = np.arange(spectra.shape[1]) * spacing_hz
        spectra *= fit.gain(np.clip(frequency_hz, low_hz, high_hz))
        analytic = _resampled(
            spectra, spacing_hz, start_s=start_s, rate_hz=output_rate_hz, n_phases=n_phases,
            n_outputs=len(range_m) + 2 * lead,
        )  # fmt: skip
        window = TimeWindow.from_start(0, n_fft=0, n_outputs=analytic.shape[2])
        with on_device(device, threads) as here:
            sent = here.lane.send(analytic)
            image = here.memory.zeros((len(angles_rad), len(range_m)), np.float32)
            for first in range(0, len(angles_rad), _DIRECTIONS_AT_A_TIME):
                part = slice(first, first + _DIRECTIONS_AT_A_TIME)
                for begin, end, distance_m in edges:  # tables of one zone at a time bound the memory
                    delays_s = own_s + aperture.delays_s(
                        aperture.directions[part], sound_speed_m_s=speed_m_s, range_m=distance_m
                    )
                    table = DelayTable.of(delays_s, amplitudes, fit, n_phases=n_phases, lead=lead)
                    zone = Zone(begin, end, table)
                    stage = BeamformFloat32(here.kernels, here.memory, window, [zone], None, threads=here.threads)
                    stage(sent, (), image[part])
            return here.fetched(image)


def _delay_fit(output_rate_hz: float, spectrum: Spectrum) -> tuple[DelayFit, int]:
    """Return the interpolation of delays, with the least oversampling that keeps its error small."""
    for n_phases in _PHASES:
        fit = DelayFit(_DELAY_TAPS, 1 / (output_rate_hz * n_phases), spectrum)
        if float((fit.errors + fit.biases) @ spectrum.power) <= 10 ** (_DELAY_ERROR_DB / 10):
            return fit, n_phases
    raise ArgumentError(
        f"ranges_m has a step of {1e3 / output_rate_hz:.3g} ms in echo time, too long for signals up to "
        f"{spectrum.frequency_hz[-1]:g} Hz; use ranges that are closer together"
    )


def _zone_count(aperture: Aperture, range_m: NDArray[np.float64], waves_per_m: float) -> int:
    """Return the number of focal zones that bounds the phase error of spherical wavefronts."""
    curvature_span = 1 / max(float(range_m[0]), NEAREST_M) - 1 / max(float(range_m[-1]), NEAREST_M)
    phase_rad = 2 * math.pi * waves_per_m * float(aperture.square_m2.max()) / 2 * curvature_span / 2
    return max(1, math.ceil(phase_rad / _ZONE_PHASE_RAD))


def _one_sided(signals: NDArray[Any], rate_hz: float) -> tuple[NDArray[np.complex128], float]:
    """Return the spectra of positive frequencies of analytic signals, (mic, bin), and the spacing of their bins."""
    n_fft = int(scipy.fft.next_fast_len(2 * signals.shape[1]))
    n_bins = n_fft // 2 + 1
    if np.iscomplexobj(signals):
        spectra = scipy.fft.fft(signals.astype(np.complex128), n_fft, axis=1)[:, :n_bins]
    else:
        spectra = scipy.fft.rfft(signals.astype(np.float64), n_fft, axis=1)
        spectra[:, 1 : (n_fft + 1) // 2] *= 2
    return np.asarray(spectra / n_fft), rate_hz / n_fft


def _occupied(spectra: NDArray[np.complex128], spacing_hz: float) -> tuple[float, float]:
    """Return the edges of the band that holds the signals."""
    level = np.sqrt(np.mean(np.abs(spectra) ** 2, axis=0))
    strong = np.flatnonzero(level >= _BAND_THRESHOLD * level.max()) * spacing_hz
    low_hz = float(strong[0])
    return low_hz, max(float(strong[-1]), low_hz + spacing_hz)


def _resampled(
    spectra: NDArray[np.complex128],
    spacing_hz: float,
    *,
    start_s: float,
    rate_hz: float,
    n_phases: int,
    n_outputs: int,
) -> NDArray[np.complex64]:
    """Return analytic signals in phases, (mic, phase, sample), by a chirp z-transform for any spacing of times."""
    n_bins = spectra.shape[1]
    frequency_hz = np.arange(n_bins) * spacing_hz
    transform = scipy.signal.CZT(n_bins, n_outputs, w=np.exp(2j * math.pi * spacing_hz / rate_hz))
    analytic = np.empty((len(spectra), n_phases, n_outputs), dtype=np.complex64)
    for phase in range(n_phases):
        shift = np.exp(2j * math.pi * frequency_hz * (start_s + phase / (n_phases * rate_hz)))
        for mic, row in enumerate(spectra):  # one at a time, so that memory stays small
            analytic[mic, phase] = transform(row * shift)
    return analytic


def directions_of(directions_rad: ArrayLike) -> NDArray[np.float64]:
    given = np.asarray(directions_rad)
    if given.ndim != 2 or given.shape[1] != 2 or not len(given) or given.dtype.kind not in "fiu":
        raise ArgumentError(
            f"directions_rad holds {given.dtype} of shape {given.shape}; use azimuth and elevation in radians, of "
            "shape (direction, 2)"
        )
    angles_rad = numbers_of("directions_rad", given, given.shape)
    for axis, limit_rad in ((0, 2 * math.pi), (1, math.pi / 2)):
        wrong = np.flatnonzero(np.abs(angles_rad[:, axis]) > limit_rad * (1 + 1e-12))
        if wrong.size:
            raise ArgumentError(
                f"directions_rad[{wrong[0]}, {axis}] is {angles_rad[wrong[0], axis]:g}; use radians from "
                f"{-limit_rad:.3g} to {limit_rad:.3g}, such as numpy.radians returns"
            )
    return angles_rad


def places_of(positions_m: ArrayLike, n_mics: int, farthest_m: float) -> NDArray[np.float64]:
    """Return microphone positions (mic, 3) of an array that is not too large; images end at farthest_m."""
    places_m = numbers_of("positions_m", positions_m, (n_mics, 3))
    span_m = float(np.ptp(places_m, axis=0).max())
    if span_m > MAX_SPAN_M:
        raise ArgumentError(
            f"positions_m spans {span_m:.4g} m, more than {MAX_SPAN_M:g} m; if the numbers are millimetres, divide "
            "them by 1000"
        )
    largest_m = float(np.linalg.norm(places_m, axis=1).max())
    if largest_m > farthest_m:
        raise ArgumentError(
            f"positions_m lie up to {largest_m:.3g} m from the origin, beyond the last of ranges_m, {farthest_m:.3g} "
            "m; if the unit is not the metre, convert it, or use wavefront='spherical'"
        )
    return places_m


def ranges_of(ranges_m: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """Return ranges and their spacing."""
    given = np.asarray(ranges_m)
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "fiu":
        raise ArgumentError(
            f"ranges_m holds {given.dtype} of shape {given.shape}; use metres of shape (range,), such as "
            "numpy.arange(0.5, 5, 0.004)"
        )
    range_m = numbers_of("ranges_m", given, given.shape)
    if range_m[0] < 0:
        raise ArgumentError(f"ranges_m begins at {range_m[0]:g} m; use ranges of 0 or more")
    if len(range_m) == 1:
        return range_m, 1e-3
    steps_m = np.diff(range_m)
    step_m = float(range_m[-1] - range_m[0]) / len(steps_m)
    if step_m <= 0 or np.abs(steps_m - step_m).max() > max(_MAX_STEP_ERROR * step_m, 1e-9 * range_m[-1]):
        raise ArgumentError(
            f"ranges_m has steps from {steps_m.min():g} to {steps_m.max():g} m; use ascending, evenly spaced ranges, "
            "such as numpy.arange(0.5, 5, 0.004)"
        )
    return range_m, step_m


def weights_of(weights: ArrayLike | None, n_mics: int) -> NDArray[np.float64]:
    """Return weights that add up to 1."""
    if weights is None:
        return np.full(n_mics, 1 / n_mics)
    given = numbers_of("weights", weights, (n_mics,))
    if given.min() < 0 or not given.sum() > 0:
        raise ArgumentError(f"weights holds {given.min():g} and adds up to {given.sum():g}; pass weights of 0 or more")
    return np.asarray(given / given.sum())
