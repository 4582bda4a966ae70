"""Checks on the spectrograms of single channels: dead, idle tone, level and noise."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis import _bits
from ertis_numba.analysis.health.levels import flip_findings, in_limit_cycles, noise_findings
from ertis_numba.analysis.health.limits import COMMON_SHARE, MAX_TONE_DB, MIN_LEVEL_DB, MIN_RISE_DB
from ertis_numba.analysis.health.report import ChannelHealth, Finding
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["by_spectra"]

_SEGMENTS = 8  # Minimum number of segments without overlap, so that some are loud and some are quiet.
_MIN_INTACT = 3  # Minimum number of segments with overlap that contain no dropout.
_LONGEST_SEGMENT = 2**14  # 3.6 ms of an eRTIS, about the length of a call, with lines of 275 Hz.
_MIN_LINES = 8  # Minimum in the call's band. With fewer lines, echoes may cancel at one microphone by chance.
_FIRST_LINE = 3  # A Hann window leaks an offset into the lines below.
_LOWEST_HZ = 20.0  # Lower limit of the audible band.
_MIN_SOUND = 1e-3  # Minimum share of the power; a smaller share is a chance result of noise.
_FLOOR_QUANTILE = 0.2
_TONE_MARGIN_DB = 3.0
_NEARLY_LOUDEST_DB = 6.0  # Level below the loudest eighth. Weaker sound is less conclusive for noisy microphones.


def by_spectra(
    signal_of: Callable[[int], NDArray[np.float32]],
    n_samples: int,
    found: Sequence[ChannelHealth],
    settings: Settings,
    band_hz: tuple[float, float],
    missing: Sequence[tuple[int, int]] = (),
) -> tuple[list[ChannelHealth], tuple[float, ...], tuple[str, ...], list[Finding]]:
    """Return channels with spectral statistics, common tones, impossible checks, and findings of level and noise."""
    size = min(_LONGEST_SEGMENT, 2 ** int(math.log2(n_samples / _SEGMENTS)))
    line_hz = settings.recording.sample_rate_hz / size
    low = round(band_hz[0] / line_hz)
    high = min(round(band_hz[1] / line_hz) + 1, size // 2)
    if not found:
        return [], (), (), []
    if high - low < _MIN_LINES or low < _FIRST_LINE:
        why = f"{n_samples} samples are too few to resolve the band of {band_hz[0] / 1e3:g} to {band_hz[1] / 1e3:g} kHz"
        return list(found), (), (f"dead microphones, tones and noise: {why}",), []
    intact = _intact(n_samples, size, missing)
    if intact.sum() < _MIN_INTACT:
        return list(found), (), ("dead microphones, tones and noise: dropouts leave too few samples",), []
    spectra = [_bits.spectrogram(signal_of(item.channel), size=size, n_lines=high)[intact] for item in found]
    power = np.stack([lines[:, low:].sum(axis=1, dtype=np.float64) for lines in spectra])
    order = np.argsort(np.median(power, axis=0), kind="stable")
    few = max(1, len(order) // 8)
    noise, loud = power[:, order[:few]].mean(axis=1), power[:, order[-few:]].mean(axis=1)
    noise_db = _bits.decibels(noise)
    quiet_db = _bits.decibels(np.sort(power, axis=1)[:, :few].mean(axis=1))
    white_db = 10 * math.log10(2 * (high - low) / size)
    # The quietest lines are an upper bound of white noise, because tones and echoes only add power.
    quiet = np.argsort(np.median(power, axis=0), kind="stable")[: max(few, 2)]
    density = np.stack([lines[quiet, _FIRST_LINE:].mean(axis=0, dtype=np.float64) for lines in spectra])
    floor_db = _bits.decibels(np.quantile(density, _FLOOR_QUANTILE, axis=1)) + 10 * math.log10(size / 2)
    sensitivity = np.abs(microphones(settings.array).gain[[item.channel for item in found]])
    sound_db = _bits.decibels(np.maximum(loud - noise, _MIN_SOUND * loud)) - 20 * np.log10(sensitivity)
    level_db = sound_db - np.median(sound_db)
    is_deaf = _deaf(power[:, order], noise, 20 * np.log10(sensitivity), few)
    unknown: tuple[str, ...] = ()
    if len(found) == 1:
        unknown = ("a dead microphone: no other channel is available for comparison",)
    elif np.median(_bits.decibels(loud) - noise_db) < MIN_RISE_DB:
        unknown = (f"dead microphones: no sound exceeds the noise by {MIN_RISE_DB:g} dB",)
    elif settings.recording.is_pdm and in_limit_cycles(quiet_db):
        unknown = ("dead microphones: the modulators are in limit cycles without noise",)
    first = max(_FIRST_LINE, math.ceil(_LOWEST_HZ / line_hz))
    # In the mean of decibels, a permanent tone exceeds intermittent echoes.
    rise_db = _bits.rises(np.stack([_bits.decibels(lines[:, first:]).mean(axis=0) for lines in spectra]))
    # A common tone near the limit may exceed the limit in some channels only, so the limit has a margin.
    is_common, _ = _bits.common_lines(rise_db, MAX_TONE_DB - _TONE_MARGIN_DB, COMMON_SHARE)
    _, common = _bits.common_lines(rise_db, MAX_TONE_DB, COMMON_SHARE)
    rise_db[:, is_common] = 0.0
    highest = np.argmax(rise_db, axis=1)
    reported = [
        replace(
            item,
            faults=item.faults
            + ("idle tone",) * bool(rise_db[mic, highest[mic]] > MAX_TONE_DB)
            + ("dead",) * bool(not unknown and is_deaf[mic]),
            level_db=None if unknown else float(level_db[mic]),
            noise_dbfs=float(noise_db[mic]),
            tone_hz=float((first + highest[mic]) * line_hz) if rise_db[mic, highest[mic]] > MAX_TONE_DB else None,
            tone_db=float(rise_db[mic, highest[mic]]),
        )
        for mic, item in enumerate(found)
    ]
    findings = noise_findings(reported, quiet_db, white_db=white_db if settings.recording.is_pdm else None)
    findings += flip_findings(reported, floor_db) if settings.recording.is_pdm else []
    return reported, tuple(float((first + line) * line_hz) for line in common), unknown, findings


def _intact(n_samples: int, size: int, missing: Sequence[tuple[int, int]]) -> NDArray[np.bool_]:
    """Return True for each segment that overlaps no missing part."""
    intact = np.ones((n_samples - size) // (size // 2) + 1, bool)
    for start, stop in missing:
        intact[max((start - size) // (size // 2) + 1, 0) : (stop - 1) // (size // 2) + 1] = False
    return intact


def _deaf(
    power: NDArray[np.float64], noise: NDArray[np.float64], sensitivity_db: NDArray[np.float64], few: int
) -> NDArray[np.bool_]:
    """Return True for each channel without sound in every eighth nearly as loud as the loudest: (mic,)."""
    is_deaf, loudest_db = np.ones(len(power), bool), math.inf
    for last in range(power.shape[1], few, -few):
        loud = power[:, max(few, last - few) : last].mean(axis=1)
        sound_db = _bits.decibels(np.maximum(loud - noise, _MIN_SOUND * loud)) - sensitivity_db
        usual_db = float(np.median(sound_db))
        if not math.isfinite(loudest_db):
            loudest_db = usual_db
        if usual_db < loudest_db - _NEARLY_LOUDEST_DB:
            break
        is_deaf &= sound_db - usual_db < MIN_LEVEL_DB
    return np.asarray(is_deaf)
