"""Signals of the microphones of measurements, up to a frequency, for sound that is not an echo."""

import math
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.base.errors import DataError
from ertis_numba.chain.demodulate import demodulation
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.waveform import decimation_taps, integer_taps
from ertis_numba.passive.bands import band_edges
from ertis_numba.pipeline.accepted_words import AcceptedWords
from ertis_numba.settings import Settings

__all__ = ["HeardSignals", "heard_bands"]

_RINGING_S: Final = 1e-3  # Time after the call in which the transducer and the filters ring.

_LARGEST: Final = 1e12  # relative to full scale
_RATE: Final = 2.5  # Least signal rate relative to the highest frequency.
_MAX_FACTOR: Final = 40  # Largest decimation; 16 bits cannot hold the filters of larger ones.


def heard_bands(settings: Settings) -> NDArray[np.float64]:
    """Return the edges of the bands of settings.passive in Hz (band, 2); raise ArgumentError if one is too high."""
    return band_edges(settings.passive, settings.recording)


class HeardSignals:
    """Demodulator of whole measurements.

    Parameters
    ----------
    settings : Settings
    highest_hz : float, optional
        Highest frequency of the signals; that of the bands of ``settings.passive`` by default.
    device : {"auto", "cpu", "cuda", "numpy"}
    threads : int, optional
        Number of threads; all cores by default.

    Attributes
    ----------
    settings : Settings
    rate_hz : float
        Rate of the signals in hertz.
    shape : (n_mics, n_samples)
        Shape of the signals.
    n_masked : int
        Samples at the start of a measurement with emission that contain its call and the ringing after it.
    band_hz : (low, high)
        Lowest and highest frequency of interest in hertz; the lowest is 0 if ``highest_hz`` is given.

    Raises
    ------
    ArgumentError
        ``highest_hz`` exceeds the highest frequency of the record.
    DeviceError
        The device is not available.
    """

    def __init__(
        self, settings: Settings, *, highest_hz: float | None = None, device: str = "auto", threads: int | None = None
    ) -> None:
        checks.instance("settings", settings, Settings, "a recording contains, or Settings.from_preset returns")
        self.settings, recording = settings, settings.recording
        lowest_hz = 0.0
        if highest_hz is None:
            bands_hz = heard_bands(settings)
            lowest_hz, highest_hz = float(bands_hz.min()), float(bands_hz.max())
        checks.between("highest_hz", highest_hz, 1.0, recording.sample_rate_hz / (_RATE if recording.is_pdm else 2))
        self.band_hz = lowest_hz, highest_hz
        factor = min(max(1, math.floor(recording.sample_rate_hz / (_RATE * highest_hz))), _MAX_FACTOR)
        self.rate_hz = recording.sample_rate_hz / factor
        self.n_masked = math.ceil((settings.call.end_s + _RINGING_S) * self.rate_hz)
        layout = microphones(settings.array)
        self._gain = layout.gain[layout.enabled].astype(np.float32)[:, None]
        self._words = AcceptedWords(settings)
        self._kernels = kernels.load(device)
        self._threads = self._kernels.max_threads if threads is None else threads
        self._memory = self._kernels.memory()
        self._lane = self._memory.lane()
        n_samples = recording.n_samples // factor
        taps = np.ones(1)
        if factor > 1 or recording.is_pdm:
            taps = decimation_taps(sample_rate_hz=recording.sample_rate_hz, decimation=factor, pass_hz=highest_hz)
        window = TimeWindow.from_start(n_samples, n_fft=n_samples)
        self._demodulate = demodulation(
            settings, layout, window, self._kernels, self._memory, taps=integer_taps(taps), factor=factor
        )
        self._room = self._demodulate.new_room()
        self.shape: tuple[int, int] = self._demodulate.shape
        self._signals = self._memory.zeros(self.shape, np.float32)

    def __call__(self, measurement: Measurement, *, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        """Return the signals of the enabled microphones, (mic, sample), divided by the calibrated gains.

        Parameters
        ----------
        measurement : Measurement
        out : (n_mics, n_samples) float32, optional
            Array for the signals; a new one by default.

        Raises
        ------
        DataError
            Its array, call, record or air are not those of the settings, or samples exceed 1e12 times full scale.
        """
        checks.instance("measurement", measurement, Measurement, "a recording contains")
        words, exponent = self._words.read(measurement)
        out = np.empty(self.shape, np.float32) if out is None else out
        with self._kernels.threads(self._threads), self._lane.entered():
            self._demodulate(self._lane.send(words), self._room, self._signals)
            self._lane.fetch(self._signals, out)
            self._lane.wait()
        with np.errstate(over="ignore", invalid="ignore"):
            out *= np.float32(2.0**exponent) / self._gain
        largest = float(max(out.max(initial=0.0), -out.min(initial=0.0)))
        if not largest <= _LARGEST:
            raise DataError(
                f"a measurement has samples above {_LARGEST:g} times full scale, whose powers exceed single precision; "
                "divide the samples by their largest value"
            )
        return out

    def close(self) -> None:
        """Free the memory of the device."""
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
