"""Signals of the microphones of measurements, up to a frequency, for sound that is not an echo."""

import math
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks, kernels
from ertis_numba.accepted_words import AcceptedWords
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.passive.bands import band_edges
from ertis_numba.settings import Settings
from ertis_numba.stages.demodulate import demodulation
from ertis_numba.stages.time_window import TimeWindow
from ertis_numba.waveform import decimation_taps, integer_taps

__all__ = ["HeardSignals"]

_RATE: Final = 2.5  # Least signal rate relative to the highest frequency.


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
        checks.instance("settings", settings, Settings, "a recording holds, or Settings.from_preset returns")
        self.settings, recording = settings, settings.recording
        most_hz, lowest_hz = recording.sample_rate_hz / _RATE, 0.0
        if highest_hz is None:
            bands_hz = band_edges(settings.passive, highest_hz=most_hz)
            lowest_hz, highest_hz = float(bands_hz.min()), float(bands_hz.max())
        checks.between("highest_hz", highest_hz, 1.0, most_hz)
        self.band_hz = lowest_hz, highest_hz
        factor = max(1, math.floor(recording.sample_rate_hz / (_RATE * highest_hz)))
        self.rate_hz = recording.sample_rate_hz / factor
        layout = microphones(settings.array)
        self._gain = layout.gain[layout.enabled].astype(np.float32)[:, None]
        self._words = AcceptedWords(settings)
        self._kernels = kernels.load(device)
        self._threads = self._kernels.max_threads if threads is None else threads
        self._memory = self._kernels.memory()
        self._lane = self._memory.lane()
        n_samples = recording.n_samples // factor
        taps = decimation_taps(sample_rate_hz=recording.sample_rate_hz, decimation=factor, pass_hz=highest_hz)
        window = TimeWindow.from_start(n_samples, n_fft=n_samples)
        self._demodulate = demodulation(
            settings, layout, window, self._kernels, self._memory, taps=integer_taps(taps), factor=factor
        )
        self._room = self._demodulate.new_room()
        self._signals = self._memory.zeros(self._demodulate.shape, np.float32)

    def __call__(self, measurement: Measurement) -> NDArray[np.float32]:
        """Return the signals of the enabled microphones, (mic, sample), divided by the calibrated gains.

        Raises
        ------
        DataError
            Its array, call, record or air are not those of the settings.
        """
        checks.instance("measurement", measurement, Measurement, "a recording holds")
        words, exponent = self._words.read(measurement)
        out = np.empty(self._demodulate.shape, np.float32)
        with self._kernels.threads(self._threads), self._lane.entered():
            self._demodulate(self._lane.send(words), self._room, self._signals)
            self._lane.fetch(self._signals, out)
            self._lane.wait()
        return np.asarray(out * (np.float32(2.0**exponent) / self._gain))

    def close(self) -> None:
        """Free the memory of the device."""
        self._memory.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
