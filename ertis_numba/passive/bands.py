"""Bands of frequencies, and the bins of a spectrum that belong to them."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.constants import SHAPED_NOISE_SHARE
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import HIGHEST_SHARE, Passive, Recording, Settings

__all__ = ["band_edges", "bin_shares", "octave_bands", "shaped_noise_warning", "typed_hz"]

_ROUNDING = 1e-6  # relative, so that limits include the bands whose edges they name


def octave_bands(low_hz: float, high_hz: float, *, fraction: int = 3) -> NDArray[np.float64]:
    """Return the edges in Hz of the octaves or thirds that lie between two frequencies: (band, 2)."""
    # Centres are `1000 · G^(k / fraction)` with `G = 10^0.3` (IEC 61260-1:2014, equations 2 and 4).
    step = 0.3 / fraction
    lowest = math.ceil((math.log10(low_hz / 1e3) - _ROUNDING) / step + 0.5)
    highest = math.floor((math.log10(high_hz / 1e3) + _ROUNDING) / step - 0.5)
    centres = 1e3 * 10.0 ** (step * np.arange(lowest, highest + 1))
    return np.stack([centres * 10 ** (-step / 2), centres * 10 ** (step / 2)], axis=1)


def band_edges(passive: Passive, recording: Recording) -> NDArray[np.float64]:
    """Return edges (band, 2) of possible named bands, or of all listed ones; raise ArgumentError if one is too high."""
    # Named bands beyond 0.8 of half of the recording's sample rate are left out.
    given, highest_hz = passive.bands_hz, HIGHEST_SHARE * recording.sample_rate_hz / 2
    if isinstance(given, str):
        low_hz, high_hz = passive.limits_of(recording)
        bands = octave_bands(low_hz, min(high_hz, highest_hz), fraction=1 if given == "octaves" else 3)
        if passive.limits_hz is None and not recording.is_pdm:
            bands = _widened(bands, low_hz, high_hz)
        if not len(bands):
            raise ArgumentError(
                f"passive.limits_hz {low_hz:g} to {high_hz:g} contains none of the {given.replace('_', ' ')} up to "
                f"{highest_hz:g} Hz, the highest frequency of the record; use wider limits, or your own bands_hz"
            )
        return bands
    for number, (_, high_hz) in enumerate(given):
        if high_hz > highest_hz:
            raise ArgumentError(
                f"passive.bands_hz[{number}] ends at {high_hz:g} Hz, but the record reaches only {highest_hz:g} Hz; "
                "lower the upper edge of this band"
            )
    return np.array(given, np.float64)


def _widened(bands_hz: NDArray[np.float64], low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Return bands whose outermost edges are the limits; at least one band."""
    if not len(bands_hz):
        return np.array([[low_hz, high_hz]])
    bands_hz[0, 0], bands_hz[-1, 1] = low_hz, high_hz
    return bands_hz


def shaped_noise_warning(settings: Settings, bands_hz: NDArray[np.float64]) -> str:
    """Return a line on bands in which the noise of one-bit microphones dominates; empty if there are none."""
    limit_hz = SHAPED_NOISE_SHARE * settings.recording.sample_rate_hz
    noisy = bands_hz[bands_hz[:, 1] > limit_hz]
    if not settings.recording.is_pdm or not len(noisy):
        return ""
    named = ", ".join(f"{low_hz / 1e3:g} to {high_hz / 1e3:g} kHz" for low_hz, high_hz in noisy[:3])
    more = f" and {len(noisy) - 3} more" if len(noisy) > 3 else ""
    return (
        f"the quantisation noise of one-bit microphones dominates above {limit_hz / 1e3:g} kHz, and therefore in "
        f"{named}{more}; choose lower bands to hear sources"
    )


def typed_hz(frequency_hz: float) -> str:
    """Return a frequency as it is typed, with at least three digits."""
    return f"{frequency_hz:.0f}" if frequency_hz >= 100 else f"{frequency_hz:.3g}"


def bin_shares(bands_hz: NDArray[np.float64], frequency_hz: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the share of each bin, of two or more with equal spacing, that lies within each band: (band, bin)."""
    spacing_hz = frequency_hz[1] - frequency_hz[0]
    low_hz, high_hz = bands_hz[:, :1], bands_hz[:, 1:]
    inside = np.minimum(high_hz, frequency_hz + spacing_hz / 2) - np.maximum(low_hz, frequency_hz - spacing_hz / 2)
    return np.asarray(np.clip(inside / spacing_hz, 0, 1), np.float32)
