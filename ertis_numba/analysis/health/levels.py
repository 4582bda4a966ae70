"""Checks of the level and the noise of each channel, relative to the array's median."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.limits import (
    MAX_FLIPPED_DB,
    MAX_FLIPS_DB,
    MAX_GAIN_DB,
    MAX_NOISE_DB,
    MAX_WHITE_DB,
)
from ertis_numba.analysis.health.report import ChannelHealth, Finding

__all__ = ["flip_findings", "gain_findings", "in_limit_cycles", "noise_findings"]

_MIN_CHANNELS = 5  # Minimum number for a median and a spread.
_DEVIATIONS = 5.0  # Limit in standard deviations of the array's own spread.
_NORMAL = 1.4826  # Ratio of the standard deviation of a normal distribution to its median absolute deviation.
_LOWEST_NOISE_DB = -100.0  # Noise in the call's band; only rounding and the ends of echoes lie below.
_MAX_LEVEL_DB = 20.0
_LIMIT_CYCLE_DB = -120.0  # Noise of PDM in the call's band, far below the noise of any modulator.
_SHARE_OF_LIMIT_CYCLES = 0.1


def in_limit_cycles(quiet_db: NDArray[np.float64]) -> bool:
    """Return True if too many PDM modulators are in limit cycles without noise, so channels cannot be compared."""
    return float(np.mean(quiet_db < _LIMIT_CYCLE_DB)) > _SHARE_OF_LIMIT_CYCLES


def _limit(values_db: NDArray[np.float64], min_db: float) -> tuple[NDArray[np.float64], float]:
    """Return the deviations from the median, and the limit that the array's own spread allows."""
    deviation_db = values_db - np.median(values_db)
    return deviation_db, max(min_db, _DEVIATIONS * _NORMAL * float(np.median(np.abs(deviation_db))))


def gain_findings(channels: Sequence[int], level_db: NDArray[np.float64]) -> list[Finding]:
    """Return the channels in which the strongest arrival is too loud or too quiet; NaN for another waveform."""
    known = np.isfinite(level_db)
    if known.sum() < _MIN_CHANNELS:
        return []
    deviation_db, limit_db = _limit(level_db[known], MAX_GAIN_DB)
    return [
        Finding(fault="gain", channels=(channel,), measured=float(value), limit=limit_db)
        for channel, value in zip(np.asarray(channels)[known].tolist(), deviation_db, strict=True)
        if abs(value) > limit_db
    ]


def noise_findings(
    channels: Sequence[ChannelHealth], quiet_db: NDArray[np.float64], *, white_db: float | None
) -> list[Finding]:
    """Return the channels with more noise than the others, each in its own quietest eighth of the record."""
    if len(channels) < 2 or (white_db is not None and in_limit_cycles(quiet_db)):
        return []
    usual_db = np.maximum(quiet_db, _LOWEST_NOISE_DB)
    deviation_db, limit_db = _limit(usual_db, MAX_NOISE_DB)
    if len(channels) < _MIN_CHANNELS:
        deviation_db, limit_db = usual_db - np.min(usual_db), _MAX_LEVEL_DB
    found = []
    for item, more_db, noise_db in zip(channels, deviation_db.tolist(), quiet_db.tolist(), strict=True):
        if more_db <= limit_db:
            continue
        if white_db is not None and noise_db > white_db + MAX_WHITE_DB and "idle tone" not in item.faults:
            found.append(
                Finding(fault="white bits", channels=(item.channel,), measured=noise_db - white_db, limit=MAX_WHITE_DB)
            )
        else:
            found.append(Finding(fault="noisy", channels=(item.channel,), measured=more_db, limit=limit_db))
    return found


def flip_findings(channels: Sequence[ChannelHealth], floor_db: NDArray[np.float64]) -> list[Finding]:
    """Return the PDM channels whose noise floor, in dB relative to white bits, indicates flipped bits.

    A share ``p`` of flipped bits adds ``4 p (1 - p)`` of the power of white bits, equally at all frequencies.
    """
    return [
        Finding(fault="flipped bits", channels=(item.channel,), measured=value, limit=MAX_FLIPPED_DB)
        for item, value in zip(channels, floor_db.tolist(), strict=True)
        if MAX_FLIPPED_DB < value <= MAX_FLIPS_DB and not item.faults
    ]
