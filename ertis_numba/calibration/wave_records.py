"""Analytic signals of a measurement after the matched filter, in which waves are searched."""

import functools
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed, compress
from ertis_numba.base.errors import DataError
from ertis_numba.calibration.sounds import _signals
from ertis_numba.calibration.spherical_waves import wave_lags
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import absorption_db_m
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Air, Array, Call

__all__ = ["FINER", "EchoPulses", "WaveRecord", "WorkingMicrophones", "wave_record"]

_MIN_MICROPHONES: Final = 6
_OVERSAMPLING: Final = 4
_DIRECTION_STEP: Final = 0.045  # Of direction cosines; 8 cm from the centre, this is half of the width of a pulse.
_FLAT_M: Final = 1e-3
_REGULARISATION: Final = 0.03  # Power of the call below which its spectrum is not flattened, relative to the maximum.
FINER: Final = 16
"""Steps of the pulses of echoes per step of the signals."""
_ABSORPTION_STEP_M: Final = 0.25


@dataclass(slots=True, eq=False)
class WorkingMicrophones:
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
class EchoPulses:
    """Pulses of single echoes, by the length of their path."""

    filter: NDArray[np.float64]
    spectrum: NDArray[np.float64]
    absorption_1_m: NDArray[np.float64]
    middle: int
    n_steps: int
    made: dict[int, NDArray[np.complex128]] = field(default_factory=dict)

    def after(self, path_m: float) -> NDArray[np.complex128]:
        """Return the pulse, at steps that are shorter by `FINER`: (step,) complex128."""
        number = round(path_m / _ABSORPTION_STEP_M)
        if number not in self.made:
            bins = self.spectrum * np.exp(-self.absorption_1_m * number * _ABSORPTION_STEP_M)
            padded = np.zeros(FINER * self.n_steps, np.complex128)
            padded[: len(bins)] = bins
            self.made[number] = scipy.fft.ifft(np.roll(padded, -self.middle)) * FINER
        return self.made[number]


@dataclass(slots=True, eq=False)
class WaveRecord:
    """Analytic signals at baseband, from which waves that were found are subtracted."""

    signals: NDArray[np.complex128]
    envelope: NDArray[np.float64]
    step_s: float
    start_s: float
    centre_hz: float
    bandwidth_hz: float
    pulses: EchoPulses


@functools.lru_cache(maxsize=64)
def _receivers(array: Array, faulty: tuple[int, ...] = ()) -> WorkingMicrophones:
    layout = microphones(array)
    channels = np.setdiff1d(np.flatnonzero(layout.enabled), faulty)
    return WorkingMicrophones(channels, layout.positions_m[channels], layout.delay_s[channels], layout.gain[channels])


def wave_record(measurement: Measurement) -> tuple[WaveRecord, WorkingMicrophones]:
    """Return the signals, and the working microphones; raise DataError for fewer than 6, or mostly saturated ones."""
    settings = measurement.settings
    receivers = _receivers(settings.array)
    signals, _, stuck, loud, n_samples = _signals(measurement, receivers.channels)
    if 2 * len(loud) > len(receivers.channels):
        raise DataError(f"{len(loud)} of {len(receivers.channels)} channels are saturated; lower the emission level")
    works = ~np.isin(receivers.channels, [*stuck, *loud])
    if works.sum() < _MIN_MICROPHONES:
        raise DataError(f"{int(works.sum())} channels work, but {_MIN_MICROPHONES} are needed; repair the array")
    if not works.all():
        receivers = _receivers(settings.array, tuple(receivers.channels[~works].tolist()))
    rate_hz = settings.recording.sample_rate_hz
    pulses = compress(signals, receivers.channels.tolist(), settings.call, rate_hz=rate_hz, first=0, last=n_samples)
    return _at_baseband(measurement, pulses, receivers.gain), receivers


def _at_baseband(measurement: Measurement, pulses: Compressed, gain: NDArray[np.float64]) -> WaveRecord:
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
    return WaveRecord(
        signals,
        np.abs(signals),
        step_s,
        pulses.origin_s - first * step_s,
        float(pulses.frequency_hz[middle]),
        band_hz,
        pulse,
    )


@functools.lru_cache(maxsize=16)
def _pulses(call: Call, air: Air, low_hz: float, high_hz: float, n_bins: int, n_steps: int) -> EchoPulses:
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
    return EchoPulses(shape, spectrum, absorption_1_m, middle, n_steps)


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
