"""Converters of microphones that give PCM: noise, rounding and a full scale."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.settings import Recording

__all__ = ["QUANTISATION_DBFS", "Converter"]

QUANTISATION_DBFS = {"int16": -20 * np.log10(2.0**15 * np.sqrt(12)), "float32": -150.0}
"""Root mean square of what rounding adds, full scale 1: a step by √12, or less than any microphone has."""


class Converter:
    """Turns the signals of some microphones into numbers, block by block.

    Parameters
    ----------
    recording : Recording
        Whose encoding counts.
    keys : (mic,) uint64
        Of the noise of each microphone.
    noise_rms : float
    """

    def __init__(self, recording: Recording, keys: NDArray[np.uint64], noise_rms: float) -> None:
        checks.choice("recording.encoding", recording.encoding, QUANTISATION_DBFS)
        self._rounded = recording.encoding == "int16"
        self._full_scale = recording.full_scale
        self._noise_rms = noise_rms
        self._noise = [np.random.Generator(np.random.Philox(key=int(key))) for key in keys]

    def process(self, signals: NDArray[np.float64], *, out: NDArray[np.int16] | NDArray[np.float32]) -> None:
        """Fill the numbers of the next block; what is beyond full scale is cut off.

        Parameters
        ----------
        signals : (mic, sample) float64
            Full scale 1, finite. They may go on after the block.
        out : (sample, mic) int16 or float32
        """
        for mic, noise in enumerate(self._noise):
            heard = signals[mic, : len(out)]
            if self._noise_rms:
                heard = heard + self._noise_rms * noise.standard_normal(len(out))
            if self._rounded:
                heard = np.rint(heard * self._full_scale)
            largest = self._full_scale - self._rounded  # +32768 is no number of 16 bits
            out[:, mic] = np.clip(heard, -self._full_scale, largest)
