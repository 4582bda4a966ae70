"""Checks on the samples of single PCM channels: stuck, saturated, offset."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.limits import MAX_OFFSET, MAX_SATURATED, MAX_SWAP_DB, MIN_CHANGES, OFFSET_DEVIATIONS
from ertis_numba.analysis.health.report import ChannelHealth, Finding

__all__ = ["by_numbers", "scaled", "sounding_part", "swapped_bytes"]

# The largest 16-bit sample, relative to full scale. float32 has no limit, so it clips at the level of its source.
_FULL = 1 - 2.0**-15
_STEP = 2.0**-15
_FLOAT_WIDTH = 2.0**-12  # Width of the values below the extremes of float samples, relative to their peak.
_MIN_STEPS = 64  # Least peak in steps; small noise has many equal samples.
_MIN_VALUES = 4  # Least number of different values in the upper half.
_SPIKE = 8.0  # Samples at an extreme, relative to those in four steps below.


def scaled(words: NDArray[Any], full: float, channel: int) -> NDArray[np.float32]:
    """Return the samples of a PCM channel, scaled to a full scale of 1."""
    return np.asarray(np.multiply(words[:, channel], np.float32(1 / full), dtype=np.float32))


def sounding_part(words: NDArray[Any], enabled: NDArray[np.intp]) -> slice:
    """Return the samples without silence at both ends, where all enabled channels are 0; or all samples."""
    sounding = np.flatnonzero((words[:, enabled] != 0).any(axis=1))
    return slice(int(sounding[0]), int(sounding[-1]) + 1) if len(sounding) else slice(None)


def by_numbers(channel: int, signal: NDArray[np.float32], *, is_float: bool) -> ChannelHealth:
    """Return the statistics and faults of a PCM channel that need no spectrum."""
    changes = float(np.mean(signal[1:] != signal[:-1]))
    peak = float(np.abs(signal).max())
    overload, clip = _clipped(signal, peak, 0.0 if is_float else _STEP)
    offset = float(np.mean(signal, dtype=np.float64))
    if changes < MIN_CHANGES:
        faults: tuple[str, ...] = (f"stuck at {float(np.median(signal)):g}",)
    else:
        full = max(1.0, peak) if is_float else 1.0
        deviation = float(np.std(signal, dtype=np.float64)) / math.sqrt(len(signal))
        max_offset = MAX_OFFSET * full + OFFSET_DEVIATIONS * deviation
        faults = ("saturated",) * (overload > MAX_SATURATED) + ("offset",) * (abs(offset) > max_offset)
    clip_dbfs = 20 * math.log10(clip) if "saturated" in faults else None
    return ChannelHealth(
        channel=channel, faults=faults, offset=offset, changes=changes, overload=overload, clip_dbfs=clip_dbfs
    )


def _clipped(signal: NDArray[np.float32], peak: float, step: float) -> tuple[float, float]:
    """Return the share of samples at the limits of a converter or of an amplifier before it, and the level of these."""
    # A sine has 1.4 times as many samples within `step` of its extremes as just below, and noise fewer.
    width = step or peak * _FLOAT_WIDTH
    overload = float(np.mean(np.abs(signal) >= (_FULL if step else peak)))
    if overload > MAX_SATURATED or peak < _MIN_STEPS * width:
        return overload, peak
    share, levels = 0.0, []
    for side in (signal, -signal):
        top = float(side.max())
        n_top = int(np.count_nonzero(side >= top - 1.5 * step))
        n_below = int(np.count_nonzero(side >= top - 1.5 * step - 4 * width)) - n_top
        if top > 0 and n_top > _SPIKE * (n_below + 1) and not _is_steady(side, top - 1.5 * step, n_top):
            share += n_top / len(side)
            levels.append(top)
    return (share, min(levels)) if share > MAX_SATURATED else (overload, peak)


def _is_steady(side: NDArray[np.float32], top: float, n_top: int) -> bool:
    """Return True for a steady tone without noise, whose other values are few, or as frequent as its largest ones."""
    counts = np.unique(side[(side > top / 2) & (side < top)], return_counts=True)[1]
    return bool(n_top <= _SPIKE * counts.max(initial=0)) or len(counts) < _MIN_VALUES


def swapped_bytes(words: NDArray[np.int16], channels: tuple[int, ...]) -> list[Finding]:
    """Return a finding if consecutive 16-bit samples differ less after a swap of their bytes."""
    if not (words & 0xFF).any():  # Samples of 8 bits, as of WAV files.
        return []
    roughness = []
    for numbers in (words, words.byteswap()):
        steps = np.diff(numbers[:, list(channels)].astype(np.float64), axis=0)
        roughness.append(float(np.median(np.mean(np.abs(steps), axis=0))) + 1.0)
    ratio_db = 20 * math.log10(roughness[0] / roughness[1])
    if ratio_db <= MAX_SWAP_DB:
        return []
    return [Finding(fault="order of bytes", channels=channels, measured=ratio_db, limit=MAX_SWAP_DB)]
