"""Waves in one measurement: calls that arrive at the microphones of one sensor, strongest first."""

import functools
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m, sound_speed_m_s
from ertis_numba.analysis.health.arrival import Compressed, compress
from ertis_numba.calibration.sounds import _signals
from ertis_numba.calibration.spherical_waves import N_PARAMETERS, fit_wave, wave_lags, wave_slopes
from ertis_numba.errors import DataError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.settings import Air, Array, Call
from ertis_numba.waveform import call_samples

__all__ = ["Wave", "find_waves"]

_MIN_MICROPHONES: Final = 6
_MAX_WAVES: Final = 28
_OVERSAMPLING: Final = 4
_PROMINENCE: Final = 7.0  # Smallest peak of an envelope relative to its median over time.
_DYNAMIC_RANGE: Final = 0.005  # Amplitude of the weakest wave relative to the strongest peak.
_DIRECTION_STEP: Final = 0.045  # Of direction cosines; 8 cm from the centre, this is half of the width of a pulse.
_N_SEARCHED: Final = 10  # Microphones of the first search.
_PULSE_WIDTHS: Final = 2.0  # Half of the time around an arrival, in units of 1 / bandwidth.
_MIN_COHERENCE: Final = 0.5  # Power of the common pulse relative to that of all microphones.
_SEARCH_WIDTHS: Final = 1.2  # Distance of a microphone's peak from the expected time, in the same units.
_FLAT_M: Final = 1e-3
_REGULARISATION: Final = 0.03  # Power of the call below which its spectrum is not flattened, relative to the maximum.
_FINER: Final = 16
_ABSORPTION_STEP_M: Final = 0.25
_NEAR_M: Final = 0.4  # Path up to which sources may be other sensors beside the array.
_NEAREST_M: Final = 0.03
_CURVATURES: Final = np.geomspace(0.1, 1 / _NEAREST_M, 24)
_MAX_MISSES: Final = 12  # Peaks in succession that belong to no wave, after which the rest is noise.
_GHOST: Final = 0.15  # Amplitude of a side lobe relative to its pulse.
_GHOST_WIDTHS: Final = 3.5  # Distance of side lobes from a pulse, in units of 1 / bandwidth.
_GHOST_COSINE: Final = 0.03
_MIN_CONTRAST: Final = 0.5  # Level of the sum of envelopes, relative to the peak that started the search.

# Errors that noise does not explain, such as those of the positions of the microphones.
_MODEL_SD: Final = np.array([0.3e-3, 1e-3, 1e-3, 1e-3, 0.03])
_OVERLAP_SD_M: Final = 12e-3  # Error of the path for a pulse that has nothing in common with that of one echo.


class Wave(NamedTuple):
    """Call that arrives at a sensor as a spherical wave.

    Attributes
    ----------
    parameters : (parameter,) float64
        Path from the emission to the origin of the sensor in metres, direction to the source x, y and z, and curvature,
        the inverse distance of the source, in 1/m.
    information : (parameter, parameter) float64
        Inverse of the covariance; singular if the array is flat.
    amplitude : float
        Amplitude after the matched filter.
    """

    parameters: NDArray[np.float64]
    information: NDArray[np.float64]
    amplitude: float

    @property
    def path_m(self) -> float:
        """Path from the emission to the origin of the sensor."""
        return float(self.parameters[0])

    @property
    def curvature_sd_1_m(self) -> float:
        """Standard deviation of the curvature if the direction is known."""
        return float(1 / np.sqrt(max(self.information[4, 4], 1e-12)))


@dataclass(slots=True, eq=False)
class _Receivers:
    """Microphones of a sensor, and their lags for the waves of the search."""

    channels: NDArray[np.intp]
    positions_m: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    gain: NDArray[np.float64]
    lags_m: dict[float, NDArray[np.float32]] = field(default_factory=dict)

    def directions(self) -> NDArray[np.float64]:
        """Return the directions to search: (direction, axis) float64."""
        return _directions(is_flat=bool(np.ptp(self.positions_m[:, 0]) < _FLAT_M))

    def lags_of(self, curvature_1_m: float) -> NDArray[np.float32]:
        """Return the lags of all microphones for all directions: (direction, mic) float32."""
        if curvature_1_m not in self.lags_m:
            directions = self.directions()
            curvatures = np.full(len(directions), curvature_1_m)
            lags_m = wave_lags(directions, curvatures, self.positions_m)
            self.lags_m[curvature_1_m] = lags_m.astype(np.float32)
        return self.lags_m[curvature_1_m]


@dataclass(slots=True, eq=False)
class _Pulses:
    """Pulses of single echoes, by the length of their path."""

    filter: NDArray[np.float64]
    spectrum: NDArray[np.float64]
    absorption_1_m: NDArray[np.float64]
    middle: int
    n_steps: int
    made: dict[int, NDArray[np.complex128]] = field(default_factory=dict)

    def after(self, path_m: float) -> NDArray[np.complex128]:
        """Return the pulse, at steps that are shorter by `_FINER`: (step,) complex128."""
        number = round(path_m / _ABSORPTION_STEP_M)
        if number not in self.made:
            bins = self.spectrum * np.exp(-self.absorption_1_m * number * _ABSORPTION_STEP_M)
            padded = np.zeros(_FINER * self.n_steps, np.complex128)
            padded[: len(bins)] = bins
            self.made[number] = scipy.fft.ifft(np.roll(padded, -self.middle)) * _FINER
        return self.made[number]


@dataclass(slots=True, eq=False)
class _Record:
    """Analytic signals at baseband, from which waves that were found are subtracted."""

    signals: NDArray[np.complex128]
    envelope: NDArray[np.float64]
    step_s: float
    start_s: float
    centre_hz: float
    bandwidth_hz: float
    pulses: _Pulses


def find_waves(measurement: Measurement) -> list[Wave]:
    """Return the waves of one measurement, strongest first.

    The strongest peak of all envelopes starts a search over directions for the spherical wave whose envelopes add up
    best. The times of the microphones are then measured by their phases relative to the mean of the aligned signals,
    and a robust fit yields the wave. The mean pulse is subtracted, and the search goes on with the rest (Högbom,
    Astron. Astrophys. Suppl. 15, 1974, 417, applied to wavefronts).

    Parameters
    ----------
    measurement : Measurement

    Raises
    ------
    DataError
        Fewer than 6 microphones work, or most of them are saturated.
    """
    record, receivers = _record(measurement, _receivers(measurement.settings.array))
    speed_m_s = sound_speed_m_s(measurement.settings.air)
    floor = max(_PROMINENCE * float(np.median(record.envelope)), _DYNAMIC_RANGE * float(record.envelope.max()))
    found: list[Wave] = []
    misses = 0
    while len(found) < _MAX_WAVES and misses < _MAX_MISSES:
        mic, step = np.unravel_index(np.argmax(record.envelope), record.envelope.shape)
        peak = float(record.envelope[mic, step])
        if peak < floor:
            break
        wave = _wave_at(record, receivers, int(mic), int(step), speed_m_s)
        if wave is None:
            # The peak belongs to no wave, for example where two echoes overlap at one microphone.
            reach = round(1.0 / record.bandwidth_hz / record.step_s)
            is_near = (record.start_s + step * record.step_s) * speed_m_s < _NEAR_M
            # Remains of loud direct sound are at all microphones.
            rows = slice(None) if is_near else slice(mic, mic + 1)
            record.envelope[rows, max(0, step - reach) : step + reach + 1] = 0
            misses += 1
            continue
        found.append(wave)
        misses = 0
    return _without_ghosts(found, _GHOST_WIDTHS * speed_m_s / record.bandwidth_hz)


def _without_ghosts(found: list[Wave], width_m: float) -> list[Wave]:
    """Return waves that are not side lobes of stronger ones from the same direction."""
    kept: list[Wave] = []
    for wave in found:
        is_ghost = any(
            wave.amplitude < _GHOST * other.amplitude
            and abs(wave.path_m - other.path_m) < width_m
            and np.abs(wave.parameters[2:4] - other.parameters[2:4]).max() < _GHOST_COSINE
            for other in kept
        )
        if not is_ghost:
            kept.append(wave)
    return kept


@functools.lru_cache(maxsize=64)
def _receivers(array: Array, faulty: tuple[int, ...] = ()) -> _Receivers:
    layout = microphones(array)
    channels = np.setdiff1d(np.flatnonzero(layout.enabled), faulty)
    return _Receivers(channels, layout.positions_m[channels], layout.delay_s[channels], layout.gain[channels])


def _record(measurement: Measurement, receivers: _Receivers) -> tuple[_Record, _Receivers]:
    settings = measurement.settings
    signals, _, stuck, loud, n_samples = _signals(measurement, receivers.channels)
    if 2 * len(loud) > len(receivers.channels):
        raise DataError(f"{len(loud)} of {len(receivers.channels)} channels are saturated; lower the emission level")
    works = ~np.isin(receivers.channels, [*stuck, *loud])
    if works.sum() < _MIN_MICROPHONES:
        raise DataError(f"{int(works.sum())} channels work, but {_MIN_MICROPHONES} are needed; repair the array")
    if not works.all():
        receivers = _receivers(settings.array, tuple(receivers.channels[~works].tolist()))
    rate_hz = settings.recording.sample_rate_hz
    pulses = compress(
        signals, receivers.channels.tolist(), settings.call, rate_hz=rate_hz, first=0, last=n_samples
    )
    return _at_baseband(measurement, pulses, receivers.gain), receivers


def _at_baseband(measurement: Measurement, pulses: Compressed, gain: NDArray[np.float64]) -> _Record:
    n_bins = pulses.bins.shape[1]
    n_steps = 1 << (_OVERSAMPLING * n_bins - 1).bit_length()
    step_s = pulses.envelope.shape[1] * pulses.step_s / n_steps
    settings = measurement.settings
    pulse = _pulses(settings.call, settings.air, *pulses.frequency_hz[[0, -1]].tolist(), n_bins, n_steps)
    middle = pulse.middle
    windowed = np.pad(pulses.bins * (pulse.filter / gain[:, None]), ((0, 0), (0, n_steps - n_bins)))
    first = round((pulses.origin_s - pulses.start_s) / step_s)
    signals = np.roll(scipy.fft.ifft(np.roll(windowed, -middle, axis=1), axis=1), first, axis=1)
    band_hz = float(pulses.frequency_hz[-1] - pulses.frequency_hz[0])
    return _Record(
        signals,
        np.abs(signals),
        step_s,
        pulses.origin_s - first * step_s,
        float(pulses.frequency_hz[middle]),
        band_hz,
        pulse,
    )


@functools.lru_cache(maxsize=16)
def _pulses(call: Call, air: Air, low_hz: float, high_hz: float, n_bins: int, n_steps: int) -> _Pulses:
    """Return the filter of the signals, and the pulses after it."""
    frequency_hz = np.linspace(low_hz, high_hz, n_bins)
    rate_hz = call.sample_rate_hz
    replica = call_samples(call, rate_hz=rate_hz)
    n_fft = scipy.fft.next_fast_len(8 * len(replica), real=True)
    power = np.abs(scipy.fft.rfft(replica, n_fft)) ** 2
    power = np.interp(frequency_hz, np.fft.rfftfreq(n_fft, 1 / rate_hz), power)
    # A flat spectrum makes pulses short, and the window lowers side lobes, which would hide echoes.
    shape = np.hanning(n_bins + 2)[1:-1] / (power / power.max() + _REGULARISATION)
    spectrum = power * shape
    middle = int(np.searchsorted(np.cumsum(spectrum), spectrum.sum() / 2))
    absorption_1_m = absorption_db_m(air, frequency_hz) * (np.log(10) / 20)
    return _Pulses(shape, spectrum, absorption_1_m, middle, n_steps)


def _wave_at(record: _Record, receivers: _Receivers, mic: int, step: int, speed_m_s: float) -> Wave | None:
    """Return the wave with a peak at one microphone and time, and subtract it; None if there is none."""
    start = _searched(record, receivers, mic, step, speed_m_s)
    if start is None:
        return None
    width_m = speed_m_s / record.bandwidth_hz
    paths_m = _peaks(record, _times(start, receivers, speed_m_s), _SEARCH_WIDTHS / record.bandwidth_hz)
    paths_m = (paths_m - receivers.delay_s) * speed_m_s
    wave, weight = fit_wave(paths_m, receivers.positions_m, start, 0.2 * width_m, n_rounds=5)
    half = 2 + round(_PULSE_WIDTHS / record.bandwidth_hz / record.step_s)
    around = np.arange(-half, half + 1)
    scale_m = 0.05 * speed_m_s / record.centre_hz
    for _ in range(3):
        time_s = _times(wave, receivers, speed_m_s)
        aligned = _aligned(record, time_s, around)
        pulse, lag_s, share = _common(aligned, weight, record.centre_hz)
        paths_m = (time_s + lag_s - receivers.delay_s) * speed_m_s
        wave, weight = fit_wave(paths_m, receivers.positions_m, wave, scale_m, n_rounds=2)
    time_s = _times(wave, receivers, speed_m_s)
    aligned = _aligned(record, time_s, around)
    pulse, _, share = _common(aligned, weight, record.centre_hz)
    if share < _MIN_COHERENCE or wave[0] <= 0 or not 0.5 < np.linalg.norm(wave[1:4]) < 1.5:
        return None
    shift_s, overlap = _shape(pulse, record, float(wave[0]))
    level = (aligned @ np.conj(pulse)).real / float(np.sum(np.abs(pulse) ** 2))
    _subtract(record, time_s, pulse, level)
    wave[0] += shift_s * speed_m_s
    information = _information(paths_m, wave, weight, receivers.positions_m, overlap, shift_s * speed_m_s)
    return Wave(wave, information, float(np.abs(pulse).max()))


def _searched(
    record: _Record, receivers: _Receivers, mic: int, step: int, speed_m_s: float
) -> NDArray[np.float64] | None:
    """Return the wave of the grid of directions and curvatures whose envelopes add up best."""
    at_s = record.start_s + step * record.step_s - receivers.delay_s[mic]
    path_m = max(at_s * speed_m_s, 0.02)
    directions = receivers.directions()
    chosen = np.unique(np.append(np.linspace(0, len(receivers.channels) - 1, _N_SEARCHED).astype(int), mic))
    seed = int(np.searchsorted(chosen, mic))
    later = receivers.delay_s / record.step_s
    step_m = speed_m_s * record.step_s
    best, best_sum = None, 0.0
    for curvature in _curvatures(path_m):
        lags_m = receivers.lags_of(curvature)[:, chosen]
        here_m = lags_m[:, [seed]]
        steps = np.rint((lags_m - here_m) / step_m + (step + later[chosen] - later[mic])).astype(np.intp)
        # Steps beyond the record are those of another microphone, which is as good as noise.
        heights = record.envelope.ravel().take(steps + chosen * record.envelope.shape[1], mode="clip")
        if path_m < _NEAR_M:  # Nearby sources are louder at the nearest microphones.
            heights = heights * ((1 + curvature * lags_m) / (1 + curvature * here_m))
        sums = heights.mean(axis=1)
        highest = int(np.argmax(sums))
        if sums[highest] > best_sum:
            best_sum = float(sums[highest])
            best = np.concatenate([[path_m - lags_m[highest, seed]], directions[highest], [curvature]])
    return best if best_sum > _MIN_CONTRAST * record.envelope[mic, step] else None


def _curvatures(path_m: float) -> tuple[float, ...]:
    """Return curvatures to try for a path to one microphone: sources are at its end, or echoes at half of it."""
    if path_m > _NEAR_M:
        wanted = (1 / path_m, 2 / path_m)
    else:  # The path to the origin of the sensor may differ much from that to a microphone.
        lengths_m = [path_m + more_m for more_m in (-0.04, 0.0, 0.04, 0.08, 0.12)]
        wanted = tuple(1 / length_m for length_m in lengths_m if length_m > _NEAREST_M)
    # Few different values, so that their lags are computed once.
    return tuple(sorted({float(_CURVATURES[np.argmin(np.abs(np.log(_CURVATURES / each)))]) for each in wanted}))


@functools.cache
def _directions(*, is_flat: bool) -> NDArray[np.float64]:
    """Return unit vectors in front of the array, and behind it unless it is flat: (direction, axis) float64."""
    cosines = np.arange(-1, 1 + _DIRECTION_STEP / 2, _DIRECTION_STEP)
    y, z = (values.ravel() for values in np.meshgrid(cosines, cosines, indexing="ij"))
    inside = y**2 + z**2 < 1.0
    y, z = y[inside], z[inside]
    x = np.sqrt(np.maximum(0.0, 1 - y**2 - z**2))
    front = np.column_stack([x, y, z])
    return front if is_flat else np.concatenate([front, front * np.array([-1, 1, 1])])


def _times(wave: NDArray[np.float64], receivers: _Receivers, speed_m_s: float) -> NDArray[np.float64]:
    return (wave[0] + wave_lags(wave[1:4], wave[4], receivers.positions_m)) / speed_m_s + receivers.delay_s


def _peaks(record: _Record, time_s: NDArray[np.float64], within_s: float) -> NDArray[np.float64]:
    """Return the time of the highest peak of each envelope near the given times: (mic,) float64."""
    reach = max(1, round(within_s / record.step_s))
    centre = np.rint((time_s - record.start_s) / record.step_s).astype(np.intp)
    steps = np.clip(centre[:, None] + np.arange(-reach, reach + 1), 1, record.envelope.shape[1] - 2)
    rows = np.arange(len(time_s))
    peak = steps[rows, np.argmax(record.envelope[rows[:, None], steps], axis=1)]
    before, at, after = (record.envelope[rows, peak + shift] for shift in (-1, 0, 1))
    curvature = np.minimum(before - 2 * at + after, -1e-30)
    return record.start_s + (peak + np.clip((before - after) / (2 * curvature), -0.5, 0.5)) * record.step_s


def _aligned(record: _Record, time_s: NDArray[np.float64], around: NDArray[np.intp]) -> NDArray[np.complex128]:
    """Return the signals around the given times by cubic interpolation, at a common phase: (mic, step) complex128."""
    place = (time_s - record.start_s) / record.step_s
    whole = np.floor(place).astype(np.intp)
    weights = _cubic(place - whole)
    last = record.signals.shape[1] - 1
    rows = np.arange(len(time_s))[:, None]
    total = np.zeros((len(time_s), len(around)), np.complex128)
    for offset, weight in zip((-1, 0, 1, 2), weights, strict=True):
        steps = np.clip(whole[:, None] + around + offset, 0, last)
        total += weight[:, None] * record.signals[rows, steps]
    return total * np.exp(2j * np.pi * record.centre_hz * time_s)[:, None]


def _cubic(share: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the weights of Lagrange's cubic interpolation at four neighbours."""
    return (
        -share * (share - 1) * (share - 2) / 6,
        (share + 1) * (share - 1) * (share - 2) / 2,
        -(share + 1) * share * (share - 2) / 2,
        (share + 1) * share * (share - 1) / 6,
    )


def _common(
    aligned: NDArray[np.complex128], weight: NDArray[np.float64], centre_hz: float
) -> tuple[NDArray[np.complex128], NDArray[np.float64], float]:
    """Return the mean pulse, the delay of each microphone by its phase, and the share of power in the pulse."""
    pulse = weight @ aligned / weight.sum()
    middle = slice(aligned.shape[1] // 4, -(aligned.shape[1] // 4))
    product = aligned[:, middle] @ np.conj(pulse[middle])
    common = np.maximum(product.real, 0.0) ** 2 / max(float(np.sum(np.abs(pulse[middle]) ** 2)), 1e-300)
    power = float(np.sum(np.abs(aligned[:, middle]) ** 2))
    return pulse, -np.angle(product) / (2 * np.pi * centre_hz), float(common.sum()) / max(power, 1e-300)


def _shape(pulse: NDArray[np.complex128], record: _Record, path_m: float) -> tuple[float, float]:
    """Return the time of the highest correlation with an ideal pulse, and the share of amplitude that differs."""
    half = len(pulse) // 2
    reach = round(0.5 * _FINER / record.bandwidth_hz / record.step_s)
    shifts = np.arange(-reach, reach + 1)
    ideal = record.pulses.after(path_m)
    shifted = ideal[(_FINER * np.arange(-half, half + 1) - shifts[:, None]) % len(ideal)]
    product = np.abs(np.conj(shifted) @ pulse) / np.linalg.norm(shifted, axis=1)
    product /= max(float(np.linalg.norm(pulse)), 1e-300)
    best = int(np.argmax(product))
    different = float(np.sqrt(max(0.0, 1 - min(1.0, float(product[best])) ** 2)))
    return float(shifts[best]) * record.step_s / _FINER, different


def _subtract(
    record: _Record, time_s: NDArray[np.float64], pulse: NDArray[np.complex128], level: NDArray[np.float64]
) -> None:
    """Remove the pulse from the signals and envelopes."""
    half = len(pulse) // 2
    place = (time_s - record.start_s) / record.step_s
    whole = np.rint(place).astype(np.intp)
    steps = whole[:, None] + np.arange(-half + 2, half - 1)
    valid = (steps >= 0) & (steps < record.signals.shape[1])
    at = steps - place[:, None] + half
    first = np.floor(at).astype(np.intp)
    own = np.zeros(at.shape, np.complex128)
    for offset, weight in zip((-1, 0, 1, 2), _cubic(at - first), strict=True):
        own += weight * pulse[np.clip(first + offset, 0, len(pulse) - 1)]
    own *= (level * np.exp(-2j * np.pi * record.centre_hz * time_s))[:, None]
    rows = np.broadcast_to(np.arange(len(time_s))[:, None], steps.shape)
    record.signals[rows[valid], steps[valid]] -= own[valid]
    # Peaks that were removed because they belong to no wave stay removed.
    left = np.minimum(np.abs(record.signals[rows[valid], steps[valid]]), record.envelope[rows[valid], steps[valid]])
    record.envelope[rows[valid], steps[valid]] = left


def _information(
    paths_m: NDArray[np.float64],
    wave: NDArray[np.float64],
    weight: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    overlap: float,
    shift_m: float,
) -> NDArray[np.float64]:
    """Return the inverse of the covariance of a wave from its residuals, with the errors of the model added."""
    slopes = wave_slopes(wave[1:4], float(wave[4]), positions_m)
    rest_m = paths_m + shift_m - wave[0] - wave_lags(wave[1:4], wave[4], positions_m)
    freedom = max(1.0, float(weight.sum()) - N_PARAMETERS)
    variance = max(float(weight @ rest_m**2) / freedom, 1e-10)
    plain = (slopes.T * weight) @ slopes / variance
    extra = _MODEL_SD**2
    extra[0] += (overlap * _OVERLAP_SD_M) ** 2
    # (C + E)⁻¹ in a form that does not need the covariance C, which does not exist for a flat array.
    return np.asarray(plain - plain @ np.linalg.solve(plain + np.diag(1 / extra), plain))
