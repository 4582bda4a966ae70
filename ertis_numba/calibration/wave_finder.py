"""Waves in one measurement: calls that arrive at the microphones of one sensor, strongest first."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.calibration.spherical_waves import N_PARAMETERS, fit_wave, wave_lags, wave_slopes
from ertis_numba.calibration.wave_records import FINER, WaveRecord, WorkingMicrophones, wave_record
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["Wave", "find_waves"]

_MAX_WAVES: Final = 28
_PROMINENCE: Final = 4.5  # Smallest peak of an envelope relative to its median over time.
_DYNAMIC_RANGE: Final = 0.01  # Amplitude of the weakest echo or direct sound relative to the strongest one.
_N_SEARCHED: Final = 10  # Microphones of the first search.
_PULSE_WIDTHS: Final = 2.0  # Half of the time around an arrival, in units of 1 / bandwidth.
_MIN_COHERENCE: Final = 0.5  # Power of the common pulse relative to that of all microphones.
_SEARCH_WIDTHS: Final = 1.2  # Distance of a microphone's peak from the expected time, in the same units.
_NEAR_M: Final = 0.4  # Path up to which sources may be other sensors beside the array.
_NEAREST_M: Final = 0.03
_CURVATURES: Final = np.geomspace(0.1, 1 / _NEAREST_M, 24)
_MAX_LEVEL: Final = 4.0  # Largest level of a microphone in a wave, relative to the median.
_MAX_MISSES: Final = 12  # Peaks in succession that belong to no wave, after which the rest is noise.
_GHOST: Final = 0.15  # Amplitude of a side lobe relative to its pulse.
_GHOST_WIDTHS: Final = 3.5  # Distance of side lobes from a pulse, in units of 1 / bandwidth.
_GHOST_COSINE: Final = 0.03
_MIN_CONTRAST: Final = 0.5  # Level of the sum of envelopes, relative to the peak that started the search.

# Errors that noise does not explain, such as those of the positions of the microphones.
_MODEL_SD: Final = np.array([0.2e-3, 5e-4, 5e-4, 5e-4, 0.02])
_OVERLAP_SD_M: Final = 12e-3  # Error of the path for a pulse that has nothing in common with that of one echo.


class Wave(NamedTuple):
    """Call that arrives at a sensor as a spherical wave.

    The parameters are: path from the emission to the origin of the sensor in m, direction to the source x, y and z, and
    curvature, the inverse distance of the source, in 1/m.
    """

    parameters: NDArray[np.float64]
    information: NDArray[np.float64]  # inverse covariance of the parameters; singular if the array is flat
    amplitude: float  # after the matched filter

    @property
    def path_m(self) -> float:
        """Path from the emission to the origin of the sensor."""
        return float(self.parameters[0])

    @property
    def curvature_sd_1_m(self) -> float:
        """Standard deviation of the curvature if the direction is known."""
        return float(1 / np.sqrt(max(self.information[4, 4], 1e-12)))


def find_waves(measurement: Measurement) -> list[Wave]:
    """Return the waves of one measurement, strongest first; raise DataError if too few microphones work."""
    # The wave whose envelopes add up best is subtracted, and the search goes on with the rest (J. A. Högbom, 1974).
    record, receivers = wave_record(measurement)
    speed_m_s = sound_speed_m_s(measurement.settings.air)
    reach = round(1.0 / record.bandwidth_hz / record.step_s)
    found: list[Wave] = []
    misses, near_misses = 0, 0
    near_step = round((_NEAR_M / speed_m_s - record.start_s) / record.step_s)
    floor = _floor(record.envelope, near_step)
    while len(found) < _MAX_WAVES and misses < _MAX_MISSES:
        mic, step = divmod(int(np.argmax(record.envelope / floor)), len(floor))
        if record.envelope[mic, step] < floor[step]:
            break
        wave = _wave_at(record, receivers, mic, step, speed_m_s)
        if wave is not None:
            found.append(wave)
            misses = 0
        elif step < near_step:
            near_misses += 1
            # Remains of loud direct sound are at all microphones, and must not end the search for echoes.
            record.envelope[:, : near_step if near_misses == _MAX_MISSES else 0] = 0
            record.envelope[:, max(0, step - reach) : step + reach + 1] = 0
        else:
            # The peak belongs to no wave, for example where two echoes overlap at one microphone.
            misses += 1
            record.envelope[mic, max(0, step - reach) : step + reach + 1] = 0
    return _without_ghosts(found, _GHOST_WIDTHS * speed_m_s / record.bandwidth_hz)


def _floor(envelope: NDArray[np.float64], near_step: int) -> NDArray[np.float64]:
    """Return the smallest peak that can be a wave: (step,). Echoes may be far weaker than the earlier direct sound."""
    floor = np.full(envelope.shape[1], _PROMINENCE * float(np.median(envelope)))
    for part in (slice(None, near_step), slice(near_step, None)):
        floor[part] = np.maximum(floor[part], _DYNAMIC_RANGE * envelope[:, part].max(initial=0.0))
    return floor


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


def _wave_at(record: WaveRecord, receivers: WorkingMicrophones, mic: int, step: int, speed_m_s: float) -> Wave | None:
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
    # Complex levels also remove pulses of microphones whose delays or positions differ slightly from the layout.
    level = np.sum(aligned * np.conj(pulse), axis=1) / float(np.sum(np.abs(pulse) ** 2))
    level /= np.maximum(1.0, np.abs(level) / (_MAX_LEVEL * float(np.median(np.abs(level)))))
    _subtract(record, time_s, pulse, level)
    wave[0] += shift_s * speed_m_s
    information = _information(paths_m, wave, weight, receivers.positions_m, overlap, shift_s * speed_m_s)
    return Wave(wave, information, float(np.abs(pulse).max()))


def _searched(
    record: WaveRecord, receivers: WorkingMicrophones, mic: int, step: int, speed_m_s: float
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
    wanted = [1 / path_m, 2 / path_m]
    if path_m < _NEAR_M:  # The path to the origin of the sensor may differ much from that to a microphone.
        lengths_m = [path_m + more_m for more_m in (-0.04, 0.0, 0.04, 0.08, 0.12)]
        wanted = [1 / length_m for length_m in lengths_m if length_m > _NEAREST_M]
    # Few different values, so that their lags are computed once.
    return tuple(sorted({float(_CURVATURES[np.argmin(np.abs(np.log(_CURVATURES / each)))]) for each in wanted}))


def _times(wave: NDArray[np.float64], receivers: WorkingMicrophones, speed_m_s: float) -> NDArray[np.float64]:
    path_m = wave[0] + wave_lags(wave[1:4], wave[4], receivers.positions_m)
    return np.asarray(path_m / speed_m_s + receivers.delay_s)


def _peaks(record: WaveRecord, time_s: NDArray[np.float64], within_s: float) -> NDArray[np.float64]:
    """Return the time of the highest peak of each envelope near the given times: (mic,) float64."""
    reach = max(1, round(within_s / record.step_s))
    centre = np.rint((time_s - record.start_s) / record.step_s).astype(np.intp)
    steps = np.clip(centre[:, None] + np.arange(-reach, reach + 1), 1, record.envelope.shape[1] - 2)
    rows = np.arange(len(time_s))
    peak = steps[rows, np.argmax(record.envelope[rows[:, None], steps], axis=1)]
    before, at, after = (record.envelope[rows, peak + shift] for shift in (-1, 0, 1))
    curvature = np.minimum(before - 2 * at + after, -1e-30)
    return np.asarray(record.start_s + (peak + np.clip((before - after) / (2 * curvature), -0.5, 0.5)) * record.step_s)


def _aligned(record: WaveRecord, time_s: NDArray[np.float64], around: NDArray[np.intp]) -> NDArray[np.complex128]:
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
    return np.asarray(total * np.exp(2j * np.pi * record.centre_hz * time_s)[:, None])


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


def _shape(pulse: NDArray[np.complex128], record: WaveRecord, path_m: float) -> tuple[float, float]:
    """Return the time of the highest correlation with an ideal pulse, and the share of amplitude that differs."""
    half = len(pulse) // 2
    reach = round(0.5 * FINER / record.bandwidth_hz / record.step_s)
    shifts = np.arange(-reach, reach + 1)
    ideal = record.pulses.after(path_m)
    shifted = ideal[(FINER * np.arange(-half, half + 1) - shifts[:, None]) % len(ideal)]
    product = np.abs(np.conj(shifted) @ pulse) / np.linalg.norm(shifted, axis=1)
    product /= max(float(np.linalg.norm(pulse)), 1e-300)
    best = int(np.argmax(product))
    different = float(np.sqrt(max(0.0, 1 - min(1.0, float(product[best])) ** 2)))
    return float(shifts[best]) * record.step_s / FINER, different


def _subtract(
    record: WaveRecord, time_s: NDArray[np.float64], pulse: NDArray[np.complex128], level: NDArray[np.complex128]
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
