"""Checks for repetition: identical channels, repeated blocks, sections without a change, and hum."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.limits import MAX_HUM, MIN_REPEATED_SAMPLES
from ertis_numba.analysis.health.report import Finding

__all__ = ["duplicates", "hum", "repeated_blocks", "stuck_at_times"]

_MIN_CHANNELS = 4
_ANCHOR_EVERY = 64  # Mean distance of anchors in samples.
_MIX = np.uint64(0x9E3779B97F4A7C15)  # The golden ratio in 64 bits, as in SplitMix64.
_SHARE_OF_TWINS = 0.25  # Limit for PCM: without noise, a symmetrical array may receive identical echoes.
_MIN_CHANGING = 0.25  # Minimum share of samples in a repeated block that differ from those a few samples earlier.


def duplicates(columns: Sequence[tuple[int, NDArray[Any]]], *, is_pdm: bool) -> list[Finding]:
    """Return the groups of channels, of those that are not stuck, that are identical in every sample."""
    groups: dict[bytes, list[int]] = {}
    for channel, column in columns:
        content = np.packbits(column) if is_pdm else np.ascontiguousarray(column)
        groups.setdefault(content.tobytes(), []).append(channel)
    twins = [tuple(group) for group in groups.values() if len(group) > 1]
    if not is_pdm and len(groups) > 1 and sum(map(len, twins)) > _SHARE_OF_TWINS * len(columns):
        return []
    return [
        Finding(
            fault="duplicate",
            channels=(channel,),
            measured=1.0,
            limit=1.0,
            detail=f"identical to channel {', '.join(str(other) for other in group if other != channel)}",
        )
        for group in twins
        for channel in group
    ]


def stuck_at_times(columns: Sequence[tuple[int, NDArray[Any]]], *, largest: int) -> list[Finding]:
    """Return the channels that have a section of more than ``largest`` samples without a change."""
    found = []
    for channel, column in columns:
        changes = np.flatnonzero(column[1:] != column[:-1])
        if not len(changes):
            continue
        longest = max(int(np.diff(changes).max(initial=0)), int(changes[0]) + 1, len(column) - 1 - int(changes[-1]))
        if longest > largest:
            found.append(
                Finding(fault="stuck at times", channels=(channel,), measured=float(longest), limit=float(largest))
            )
    return found


def repeated_blocks(words: NDArray[Any], channels: tuple[int, ...]) -> list[Finding]:
    """Return a finding for the longest block of samples that occurs twice."""
    # Samples whose hash ends in six zeros are anchors; frequent distances between equal anchors are compared in full.
    n_samples = len(words)
    # With few microphones, modulators repeat their bits occasionally by chance.
    if n_samples < 2 * MIN_REPEATED_SAMPLES or len(channels) < _MIN_CHANNELS:
        return []
    octets = np.ascontiguousarray(words).view(np.uint8)
    padded = np.zeros((n_samples, -(-octets.shape[1] // 8) * 8), np.uint8)
    padded[:, : octets.shape[1]] = octets
    rows = padded.view(np.uint64)
    single = np.zeros(n_samples, np.uint64)
    for column in range(rows.shape[1]):
        single = (single ^ rows[:, column]) * _MIX
        single ^= single >> np.uint64(29)
    window = 64 if octets.shape[1] == 1 else 8
    hashed = np.zeros(n_samples - window, np.uint64)
    for offset in range(window):
        hashed = (hashed ^ single[offset : offset + len(hashed)]) * _MIX
        hashed ^= hashed >> np.uint64(32)
    places = np.flatnonzero(hashed % np.uint64(_ANCHOR_EVERY) == 0)
    values = hashed[places]
    order = np.argsort(values, kind="stable")
    same = np.flatnonzero(values[order][1:] == values[order][:-1])
    # A periodic pattern has very many equal anchors. It is a fault of its channels and is reported as such.
    if not len(same) or len(np.unique(values)) < len(values) / 4:
        return []
    distances, counts = np.unique(places[order][same + 1] - places[order][same], return_counts=True)
    best = 0, 0, 0
    for distance in distances[np.argsort(-counts)][:8].tolist():
        equal = single[distance:] == single[: n_samples - distance]
        ends = np.flatnonzero(np.diff(np.concatenate(([False], equal, [False])).astype(np.int8)))
        length = ends[1::2] - ends[::2]
        longest = int(np.argmax(length)) if len(length) else 0
        if len(length) and int(length[longest]) > best[0] and distance >= _ANCHOR_EVERY:
            first = int(ends[2 * longest])
            if not _is_cycle(single[first : first + int(length[longest])]):
                best = int(length[longest]), first, distance
    longest_block, first, distance = best
    if longest_block < MIN_REPEATED_SAMPLES:
        return []
    return [
        Finding(
            fault="repeated blocks",
            channels=channels,
            measured=float(longest_block),
            limit=float(MIN_REPEATED_SAMPLES),
            detail=f"samples {first}-{first + longest_block - 1} occur again {distance} samples later",
        )
    ]


def _is_cycle(block: NDArray[Any]) -> bool:
    """Return True if a block is periodic, with a period shorter than the blocks that are reported."""
    start = block[: 4 * MIN_REPEATED_SAMPLES]
    lags = range(1, min(MIN_REPEATED_SAMPLES, len(start)))
    return any(np.mean(start[lag:] != start[:-lag]) <= _MIN_CHANGING for lag in lags)


def hum(columns: Sequence[tuple[int, NDArray[Any]]], *, block: int, full_scale: float) -> list[Finding]:
    """Return the channels with low-frequency hum that most others lack; ``block`` averages several call periods."""
    if not columns or len(columns[0][1]) < 4 * block:
        return []
    used = len(columns[0][1]) // block * block
    means = np.stack([column[:used].reshape(-1, block).mean(axis=1, dtype=np.float64) for _, column in columns])
    rms = means.std(axis=1) / full_scale
    limit = max(MAX_HUM, 4 * float(np.median(rms)))
    return [
        Finding(fault="low-frequency hum", channels=(channel,), measured=float(value), limit=limit)
        for (channel, _), value in zip(columns, rms, strict=True)
        if value > limit
    ]
