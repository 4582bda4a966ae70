"""Elements of a complete plan: spectrum, decimation filter, ringing, offsets and focal zones."""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.focal_zones import NEAREST_M, zone_edges
from ertis_numba.chain.interpolation_fit import WAVES, DelayFit, Spectrum
from ertis_numba.chain.rows import LEAST_PER_ROW, Rows, rows_of
from ertis_numba.chain.time_window import time_window
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import decimation_taps, integer_taps, matched_band_hz, matched_noise_spectrum
from ertis_numba.settings import Processing, Recording, Settings

__all__ = [
    "PlannedBeams",
    "ahead_of",
    "aperture_of",
    "beam_grid_of",
    "chain_taps",
    "delay_fit",
    "estimated",
    "estimated_errors",
    "few_delays",
    "fitted",
    "grid_points",
    "nearest_m_of",
    "planned_rows",
    "require_rows",
    "ringing_db",
    "row_aperture",
    "spectrum_of",
    "zones_of",
]

_MANY_FRACTIONS = 16  # Microphones times delay range in steps, above which the delays spread evenly over a step.
_PCM_RANGE_DB = 125.0  # Dynamic range within which sound outside the window does not affect an image of PCM.
_MAX_RINGING_DB = 160.0  # Below this level, rounding of single precision exceeds the ringing.
_MAX_PDM_RINGING_DB = 138.0  # The same for PDM, where sound outside the image exceeds it by less.
_MAX_PASS_BAND = 0.45  # relative to the signal rate; the filter becomes long beyond it
_SHORT_TAPS_DB = 65.0  # Rounding taps to 16 bits limits the stopband attenuation to this value.


@functools.lru_cache(maxsize=8)
def row_aperture(aperture: Aperture, rows: Rows) -> Aperture:
    """Return the microphones and directions along the rows as those of one line, cached like `aperture_of`."""
    along_m = aperture.positions_m[:, [rows.along]]
    return Aperture(along_m, aperture.directions[:, [rows.along]], along_m[:, 0] ** 2, aperture.axes[[rows.along]])


def planned_rows(aperture: Aperture) -> Rows | None:
    """Return the rows of an array whose beams may be summed first; None if it is no plane, or may be tilted."""
    is_plane = aperture.supports_grid and aperture.n_axes == 2
    return rows_of(aperture.positions_m) if is_plane and not aperture.is_turned else None


def require_rows(settings: Settings, aperture: Aperture) -> Rows:
    """Return the rows of an array, or refuse settings that have none."""
    rows = None if settings.processing.is_adaptive else planned_rows(aperture)
    if rows is None:
        raise ArgumentError(
            "accuracy.row_beams is true, which needs delay_and_sum without a weighting, fixed directions, and a plane "
            f"array with a mean of {LEAST_PER_ROW} or more microphones per row; leave it out or use false"
        )
    return rows


def spectrum_of(settings: Settings) -> Spectrum:
    """Return the power spectrum of the matched filter's output for white input."""
    step, given = settings.decimation, settings.processing
    processing = Processing(
        range_decimation=step,
        decimation=step,
        band_edges_hz=given.band_edges_hz,
        pre_filter=given.pre_filter,
        post_filter=given.post_filter,
        filter_rate_hz=given.filter_rate_hz,
    )
    recording = Recording(sample_rate_hz=settings.recording.sample_rate_hz)
    return _spectrum_of(Settings(call=settings.call, recording=recording, processing=processing))


@functools.lru_cache(maxsize=8)
def _spectrum_of(settings: Settings) -> Spectrum:
    """Return the spectrum, as the same object for the same call and rates, so fits to it can be cached as well."""
    return Spectrum(*matched_noise_spectrum(settings, n_waves=WAVES))


def beam_grid_of(settings: Settings, aperture: Aperture, spectrum: Spectrum) -> BeamGrid | None:
    """Return the beam grid of a complete plan; None if every direction has its own beam."""
    plan = settings.accuracy
    if not plan.beam_taps or not aperture.supports_grid:
        return None
    return BeamGrid(
        aperture,
        spectrum,
        n_taps=plan.beam_taps,
        density=plan.beam_density or 2.0,
        high_hz=settings.call.high_frequency_hz,
        sound_speed_m_s=sound_speed_m_s(settings.air),
    )


def delay_fit(settings: Settings, spectrum: Spectrum) -> tuple[DelayFit, float]:
    """Return the fractional-delay filters of a complete plan, and the time between their input samples in seconds."""
    plan = settings.accuracy
    step_s = 1 / (settings.output_rate_hz * (plan.oversampling or 1))
    return DelayFit(plan.delay_taps or 1, step_s, spectrum), step_s


def few_delays(
    aperture: Aperture,
    own_s: NDArray[np.float64],
    weights: NDArray[np.float64],
    step_s: float,
    *,
    sound_speed_m_s: float,
) -> NDArray[np.float64] | None:
    """Return all delays (delay,) in s; None if they spread evenly over a step, or change with a tilt."""
    reach_s = math.sqrt(float(np.max(aperture.square_m2, initial=0.0))) / sound_speed_m_s
    if aperture.is_turned or len(weights) * (1 + 2 * reach_s / step_s) > _MANY_FRACTIONS:
        return None
    waves_s = aperture.delays_s(aperture.directions, sound_speed_m_s=sound_speed_m_s, range_m=math.inf)
    return np.asarray(own_s - ahead_of(weights, step_s) + waves_s).ravel()


def chain_taps(settings: Settings) -> NDArray[np.int16] | NDArray[np.int32]:
    """Return the integer taps of the decimation filter of a complete plan; a single tap for PCM without decimation."""
    if settings.decimation == 1 and not settings.recording.is_pdm:
        return integer_taps(np.ones(1))
    stopband_attenuation_db = settings.accuracy.stopband_attenuation_db or 60.0
    # The paper's method also accepts rates at which the band of the matched filter exceeds half the signal rate.
    highest_hz = max(settings.call.high_frequency_hz, _MAX_PASS_BAND * settings.signal_rate_hz)
    taps = decimation_taps(
        sample_rate_hz=settings.recording.sample_rate_hz,
        decimation=settings.decimation,
        pass_hz=min(matched_band_hz(settings)[1], highest_hz),
        stopband_attenuation_db=stopband_attenuation_db,
    )
    short = settings.processing.method == "fast" and stopband_attenuation_db <= _SHORT_TAPS_DB
    return integer_taps(taps, bits=16 if short else 32)


def ringing_db(settings: Settings) -> float:
    """Return the level below its peak at which the ringing of the matched filter may be cut off."""
    # The noise of PDM bits masks ringing below the stopband. PCM has none, so all ringing must stay within the budget.
    if not settings.recording.is_pdm:
        return min(_MAX_RINGING_DB, _PCM_RANGE_DB - settings.accuracy.max_error_db)
    return min(_MAX_PDM_RINGING_DB, max(60.0, 1.2 * (settings.accuracy.stopband_attenuation_db or 60.0) - 12.0))


def ahead_of(weights: NDArray[np.float64], step_s: float) -> NDArray[np.float64]:
    """Return each microphone's fractional-delay offset in seconds, positive if earlier: (mic,) float64."""
    # Multiples of the golden ratio spread those of the few dominant microphones, and of equal delays, evenly.
    rank = np.empty(len(weights), dtype=np.intp)
    rank[np.argsort(-weights, kind="stable")] = np.arange(len(weights))
    return np.asarray(rank * (math.sqrt(5) - 1) / 2 % 1.0 * step_s)


def zones_of(settings: Settings) -> list[tuple[int, int, float]]:
    """Return the focal zones of a plan: first range, range after the last, and distance in metres of the delays."""
    range_m = time_window(settings, largest_delay_s=0.0, n_taps=1).range_m
    if settings.processing.wavefront == "plane":
        return [(0, len(range_m), math.inf)]
    return zone_edges(range_m, settings.accuracy.focal_zones or 1)


def nearest_m_of(settings: Settings) -> float:
    """Return the distance of the most curved wavefronts of an image in metres; infinite for plane ones."""
    if settings.processing.wavefront == "plane":
        return math.inf
    return max(settings.processing.range_m[0], NEAREST_M)


_MAX_APERTURES = 8  # Arrays with their directions.


_MAX_FITS = 288  # Four times the number of fits in one search.


class PlannedBeams(NamedTuple):
    """Determines a beam grid and its errors; equal if its elements are, arrays by identity."""

    aperture: Aperture
    spectrum: Spectrum
    n_taps: int
    density: float
    high_hz: float
    sound_speed_m_s: float
    nearest_m: float


@functools.lru_cache(maxsize=_MAX_FITS)
def fitted(spectrum: Spectrum, n_taps: int, step_s: float) -> tuple[DelayFit, NDArray[np.float64]]:
    """Return a fit and the magnitudes of its weights, cached because fits would dominate the time of a planner."""
    fit = DelayFit(n_taps, step_s, spectrum)
    return fit, np.abs(fit.weights(fit.fractions))


@functools.lru_cache(maxsize=_MAX_APERTURES)
def aperture_of(positions_m: bytes, directions: bytes, is_turned: bool) -> Aperture:  # noqa: FBT001  cached
    """Return the aperture, as the same object for the same positions and directions, so its errors can be cached."""
    given = (np.frombuffer(values).reshape(-1, 3) for values in (positions_m, directions))
    return Aperture.of(*given, is_turned=is_turned)


@functools.lru_cache(maxsize=_MAX_FITS)
def grid_points(beams: PlannedBeams) -> int:
    """Return the number of beam-grid points, cached because it is the same for many pipelines."""
    aperture = beams.aperture
    spacing = aperture.spacing(beams.density, high_hz=beams.high_hz, sound_speed_m_s=beams.sound_speed_m_s)
    return aperture.count_grid_points(spacing, beams.n_taps)


@functools.lru_cache(maxsize=_MAX_FITS)
def estimated_errors(beams: PlannedBeams) -> tuple[NDArray[np.float64], float]:
    """Return the errors and the squares of a beam grid, cached because they dominate the time of a planner."""
    nodes = estimated(beams)
    return nodes.errors, nodes.squares


def estimated(beams: PlannedBeams) -> BeamGrid:
    """Return a beam grid whose errors are estimated."""
    return BeamGrid(
        beams.aperture,
        beams.spectrum,
        n_taps=beams.n_taps,
        density=beams.density,
        high_hz=beams.high_hz,
        sound_speed_m_s=beams.sound_speed_m_s,
        estimate=True,
        nearest_m=beams.nearest_m,
    )
