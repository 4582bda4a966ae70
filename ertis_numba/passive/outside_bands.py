"""Sound outside of the bands of acoustic maps, which maps do not show."""

import math
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.passive.bands import typed_hz
from ertis_numba.settings import HIGHEST_SHARE, Settings

__all__ = ["OutsideBands"]

_BLOCK: Final = 4096
_LEAST_BLOCKS: Final = 4
_CHANNELS: Final = 4
_OF_OFFSET: Final = 3  # Lowest bins, into which the window spreads an offset, which is no sound.
_LOUDER: Final = 2.0  # Power outside relative to that inside, per hertz or in the loudest bin, that is worth a note.
_BESIDE: Final = 2  # Bins on each side into which the window spreads a tone.


class OutsideBands:
    """Spectrum of the sound in measurements with PCM, compared with bands."""

    # A note is worth 3 dB more power per hertz, or in the loudest bin, outside. One-bit microphones, own bands and
    # measurements with a call yield none.

    def __init__(self, settings: Settings, bands_hz: NDArray[np.float64]) -> None:
        self._recording = recording = settings.recording
        self._is_left_out = recording.is_pdm or not settings.passive.follows_record
        enabled = np.flatnonzero(microphones(settings.array).enabled)
        self._channels = enabled[np.linspace(0, len(enabled) - 1, min(_CHANNELS, len(enabled))).astype(int)]
        self._size = max(8, 2 * (min(_BLOCK, recording.n_samples // _LEAST_BLOCKS) // 2))
        self._window = scipy.signal.get_window("hann", self._size)
        self._frequency_hz = np.arange(self._size // 2 + 1) * recording.sample_rate_hz / self._size
        inside = (self._frequency_hz >= bands_hz[:, :1]) & (self._frequency_hz <= bands_hz[:, 1:])
        self._inside = inside.any(axis=0)
        self._edges_hz = float(bands_hz.min()), float(bands_hz.max())
        self._power = np.zeros(len(self._frequency_hz))
        self._count = 0

    def add(self, measurement: Measurement) -> None:
        """Add the spectra of a measurement, unless it is left out."""
        has_call = measurement.stamp.behaviour == "active"
        if self._is_left_out or has_call or len(measurement.data) < self._size:
            return
        hop = self._size // 2
        scale = 2 / (self._size * float((self._window**2).sum()) * self._recording.full_scale**2)
        for channel in self._channels.tolist():
            samples = measurement.data[:, channel].astype(np.float64)
            pieces = np.lib.stride_tricks.sliding_window_view(samples - samples.mean(), self._size)[::hop]
            self._power += scale * (np.abs(scipy.fft.rfft(pieces * self._window)) ** 2).sum(axis=0)
            self._count += len(pieces)

    @property
    def note(self) -> str | None:
        """Note with the share of power outside of the bands, and the frequency and level of its maximum, or None."""
        is_sound = np.arange(len(self._power)) >= _OF_OFFSET
        inside, outside = self._power[self._inside & is_sound], self._power * (is_sound & ~self._inside)
        total, n_outside = float(inside.sum() + outside.sum()), int((is_sound & ~self._inside).sum())
        if not (len(inside) and n_outside and total > 0 and math.isfinite(total)):
            return None
        is_dense = outside.sum() / n_outside > _LOUDER * inside.mean()
        if not (is_dense or outside.max() > _LOUDER * inside.max()):
            return None
        place = int(outside.argmax())
        beside = self._power[max(_OF_OFFSET, place - _BESIDE) : place + _BESIDE + 1].sum() / self._count
        frequency_hz = float(self._frequency_hz[place])
        low_hz, high_hz = self._edges_hz
        return (
            f"{100 * float(outside.sum()) / total:.3g} % of the sound power is outside of the bands "
            f"({low_hz / 1e3:.4g} to {high_hz / 1e3:.4g} kHz), strongest at {frequency_hz / 1e3:.4g} kHz with "
            f"{10 * math.log10(max(beside, 1e-30)):.1f} dBFS; {self._remedy(frequency_hz)}"
        )

    def _remedy(self, frequency_hz: float) -> str:
        highest_hz = HIGHEST_SHARE * self._recording.sample_rate_hz / 2
        low_hz, high_hz = 0.8 * frequency_hz, min(1.2 * frequency_hz, highest_hz)
        if frequency_hz >= 0.98 * highest_hz:
            return f"to locate this sound, record at a higher rate: bands end at {highest_hz / 1e3:.4g} kHz"
        return f"to locate this sound, use the band {typed_hz(low_hz)}:{typed_hz(high_hz)} Hz (passive.bands_hz)"
