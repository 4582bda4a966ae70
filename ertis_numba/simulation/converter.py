"""Analog-to-digital converters of PCM microphones: noise, rounding and clipping."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.settings import Recording

__all__ = ["QUANTISATION_DBFS", "Converter"]

QUANTISATION_DBFS = {"int16": -20 * np.log10(2.0**15 * np.sqrt(12)), "float32": -150.0}
"""RMS of the quantisation noise in dBFS: one step / √12 for int16, and a value below any microphone for float32."""


class Converter:
    """Converts the signals of some microphones, plus white noise, to PCM samples block by block."""

    def __init__(self, recording: Recording, keys: NDArray[np.uint64], noise_rms: float) -> None:
        checks.choice("recording.encoding", recording.encoding, QUANTISATION_DBFS)
        self._rounded = recording.encoding == "int16"
        self._full_scale = recording.full_scale
        self._noise_rms = noise_rms
        self._noise = [np.random.Generator(np.random.Philox(key=int(key))) for key in keys]

    def process(self, signals: NDArray[np.float64], *, out: NDArray[np.int16] | NDArray[np.float32]) -> None:
        """Write the samples (sample, mic) of the next block; values beyond full scale, 1, are clipped."""
        for mic, noise in enumerate(self._noise):
            heard = signals[mic, : len(out)]
            if self._noise_rms:
                heard = heard + self._noise_rms * noise.standard_normal(len(out))
            if self._rounded:
                heard = np.rint(heard * self._full_scale)
            largest = self._full_scale - self._rounded  # +32768 does not fit in 16 bits
            out[:, mic] = np.clip(heard, -self._full_scale, largest)
