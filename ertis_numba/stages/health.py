"""What state the microphones of a recording are in, told from its words alone."""

import functools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings
from ertis_numba.stages import _bits
from ertis_numba.words import word_format

__all__ = ["ChannelHealth", "Health", "health", "merge"]

_MOST_SAMPLES = 2**19  # 0.1 s of an eRTIS; more tells no more
_LEAST_SAMPLES = 256
_STUCK = 1e-3  # share of changes; the bits of a silent modulator change two times out of three
# 17 equal bits are a mean beyond 0.88, which one-bit modulators follow no more. The direct sound of a real sensor
# has 0.03 % of the record in such runs, white bits 0.002 %, a call at full scale over a fourteenth of the record 1 %.
_SATURATED = 2e-3
_CHANCE_RUN = 20  # places in the longest run that white bits have by chance, which counts in short records
# A twentieth takes a tenth of the half of full scale that modulators follow. A real sensor has 0.0002.
_OFFSET = 0.05
_FULL = 1 - 2.0**-15  # of full scale: the largest number of 16 bits; float32 has no end, and clips where it did before
_OFFSET_DEVIATIONS = 5.0  # of the mean of white bits, which count in short records
_SEGMENTS = 8  # without overlap, so that some are loud and some are quiet
_LONGEST_SEGMENT = 2**14  # 3.6 ms of an eRTIS, about a call, in lines of 275 Hz
_LEAST_LINES = 8  # in the call's band; with fewer, echoes may cancel at a single microphone by chance
_FIRST_LINE = 3  # a Hann window leaks an offset into the lines before
_LOWEST_HZ = 20.0  # that can be heard
# Sound must stand out so far that what lacks it is no chance of the noise. The direct sound spreads by 6 dB, as the
# end of a line is twice as far from its middle as the median microphone; gains spread by a few more.
_RISE_DB = 9.0
_DEAD_DB = -12.0
_LEAST_SOUND = 1e-3  # of the power; less is the chance of the noise
_TONE_DB = 20.0  # a real sensor's noise, redder below 1 kHz, stands out by 15 dB, reflectors by 5
_COMMON = 0.5  # of the channels; what more of them hear is sound, or comes with the supply


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelHealth:
    """State and figures of one microphone; figures that cannot be told are None.

    Attributes
    ----------
    channel : int
        Its bit in the words, counted from 0.
    faults : tuple of str
        Of ``stuck at 0``, ``stuck at 1``, ``stuck in a pattern``, ``saturated``, ``offset``, ``idle tone`` and
        ``dead``; PCM is ``stuck`` at any number.
    offset : float or None
        Mean of the bits taken as −1 and 1, or of PCM, full scale 1.
    changes : float or None
        Share of samples that differ from the one before.
    overload : float or None
        Share of samples at which 17 equal bits begin, or that are at full scale; of float32, at the highest amplitude
        of the record.
    level_db : float or None
        Of the sound in the call's band while it is loud, the noise taken off and the calibrated gain, beside the
        median of all channels.
    noise_dbfs : float or None
        In the call's band while it is quiet: mean square of the signal, full scale 1; of float32 beyond that, the
        highest amplitude of the record.
    tone_hz, tone_db : float or None
        By how much the highest line stands out of its surroundings, in the mean over time and without lines that
        most channels hear; and where it is, if it counts as a tone.
    """

    channel: int
    faults: tuple[str, ...] = ()
    offset: float | None = None
    changes: float | None = None
    overload: float | None = None
    level_db: float | None = None
    noise_dbfs: float | None = None
    tone_hz: float | None = None
    tone_db: float | None = None

    @property
    def state(self) -> str:
        """The faults, ``ok``, or ``unknown`` where the record is too short to tell anything."""
        return ", ".join(self.faults) or ("ok" if self.offset is not None else "unknown")


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """State of an array.

    Attributes
    ----------
    channels : tuple of ChannelHealth
        The enabled ones.
    measurements : int
        How many were looked at.
    noise_dbfs : float or None
        In the call's band: mean over the channels without fault.
    dynamic_range_db : float or None
        From a full-scale echo of the whole call in every microphone down to the noise of the image.
    tones_hz : tuple of float
        Lines that most channels hear, which is a fault of none.
    unknown : tuple of str
        What could not be told, by no measurement, and why.
    """

    channels: tuple[ChannelHealth, ...]
    measurements: int = 1
    noise_dbfs: float | None = None
    dynamic_range_db: float | None = None
    tones_hz: tuple[float, ...] = ()
    unknown: tuple[str, ...] = ()

    @property
    def faults(self) -> dict[str, tuple[int, ...]]:
        """The channels of each fault that there is."""
        names = dict.fromkeys(name for item in self.channels for name in item.faults)
        return {name: tuple(item.channel for item in self.channels if name in item.faults) for name in names}

    def verdict(self) -> str:
        """Return what is wrong with which channels as a part of a line; it is empty if nothing is."""
        total = len(self.channels)
        return "; ".join(f"{name}: {_named(channels, total)}" for name, channels in self.faults.items())


def health(measurement: Measurement) -> Health:
    """Return the state of the microphones of one measurement.

    Only enabled channels are looked at, in the first 524,288 samples. Loud and quiet are the eighths of
    the record in which the median channel has most and least power in the call's band.

    The dynamic range is ``10 log10(1/2 / noise · B T · N)``: a sine at full scale, against the noise in the call's
    band, raised by a matched filter by bandwidth times duration (G. L. Turin, An introduction to matched filters,
    IRE Trans. Inf. Theory 6, 1960) and by delay and sum by the number of microphones without fault. Of the duration,
    five eighths of each ramp are taken off, as a Hann ramp has three eighths of the energy.

    Parameters
    ----------
    measurement : Measurement

    Raises
    ------
    DataError
        The words are not those of the settings.
    """
    settings, enabled = measurement.settings, np.flatnonzero(microphones(measurement.settings.array).enabled)
    words = word_format(settings).checked(measurement.words, any_length=True)[:_MOST_SAMPLES]
    if len(words) < _LEAST_SAMPLES:
        too_short = f"anything: {len(words)} samples are fewer than {_LEAST_SAMPLES}"
        return Health(channels=tuple(ChannelHealth(channel=int(i)) for i in enabled), unknown=(too_short,))
    signal_of: Callable[[int], NDArray[np.float32]]
    if settings.recording.is_pdm:
        octets = _bits.octets_of(words)
        signal_of = functools.partial(_bits.signal_of, octets)
        told = _by_bits(octets, enabled)
    else:
        full, is_float = settings.recording.full_scale, settings.recording.encoding == "float32"
        told = [_by_numbers(i, _scaled(words, full, i), is_float=is_float) for i in enabled.tolist()]
        if is_float:  # of which the amplitudes may be pascals
            full = max(full, *(float(np.abs(words[:, i]).max()) for i in enabled))
        signal_of = functools.partial(_scaled, words, full)
    found = {item.channel: item for item in told}
    moving = [item for item in told if not any(name.startswith("stuck") for name in item.faults)]
    told, tones_hz, unknown = _by_spectra(signal_of, len(words), moving, settings)
    channels = tuple((found | {item.channel: item for item in told}).values())
    noise = [10 ** (item.noise_dbfs / 10) for item in told if not item.faults and item.noise_dbfs is not None]
    report = Health(channels=channels, tones_hz=tones_hz, unknown=unknown)
    if not noise:
        return report
    call = settings.call
    noise_dbfs = 10 * math.log10(math.fsum(noise) / len(noise))
    duration_s = call.duration_s * (1 - 5 / 4 * call.ramp_fraction)
    gain = (call.high_frequency_hz - call.low_frequency_hz) * duration_s * len(noise)
    dynamic_range_db = 10 * math.log10(gain / 2) - noise_dbfs
    return replace(report, noise_dbfs=noise_dbfs, dynamic_range_db=dynamic_range_db)


def merge(reports: Sequence[Health]) -> Health:
    """Return the state of an array over several of its measurements.

    A fault is one that any of them shows; figures are medians over those that could tell.

    Raises
    ------
    ArgumentError
        There are none, or their channels differ.
    """
    if not reports:
        raise ArgumentError("reports are none; give at least one")
    first, *others = ([item.channel for item in report.channels] for report in reports)
    if any(other != first for other in others):
        raise ArgumentError("reports are of different channels; give those of one array")
    return Health(
        channels=tuple(_merged(items) for items in zip(*(report.channels for report in reports), strict=True)),
        measurements=sum(report.measurements for report in reports),
        noise_dbfs=_median(report.noise_dbfs for report in reports),
        dynamic_range_db=_median(report.dynamic_range_db for report in reports),
        tones_hz=tuple(sorted({tone_hz for report in reports for tone_hz in report.tones_hz})),
        unknown=tuple(text for text in reports[0].unknown if all(text in report.unknown for report in reports)),
    )


def _by_bits(octets: NDArray[np.uint8], enabled: NDArray[np.int64]) -> list[ChannelHealth]:
    """Return what the bits tell without a spectrum."""
    shares = {octet: _bits.bit_shares(np.ascontiguousarray(octets[:, octet])) for octet in np.unique(enabled // 8)}
    # A loud echo clips now and then; a short record may hold a run, or more of ones, by chance.
    most_runs = _SATURATED + _CHANCE_RUN / len(octets)
    most_offset = _OFFSET + _OFFSET_DEVIATIONS / math.sqrt(len(octets))
    told = []
    for channel in enabled:
        ones, changes, runs, repeats = (values[channel % 8] for values in shares[channel // 8])
        offset = 2 * float(ones) - 1
        if changes < _STUCK:
            faults: tuple[str, ...] = (f"stuck at {int(offset > 0)}",)
        elif repeats:
            faults = ("stuck in a pattern",)
        else:
            faults = ("saturated",) * bool(runs > most_runs) + ("offset",) * (abs(offset) > most_offset)
        told.append(
            ChannelHealth(
                channel=int(channel), faults=faults, offset=offset, changes=float(changes), overload=float(runs)
            )
        )
    return told


def _scaled(words: NDArray[Any], full: float, channel: int) -> NDArray[np.float32]:
    """Return a channel of PCM whose full scale becomes 1."""
    return np.asarray(np.multiply(words[:, channel], np.float32(1 / full), dtype=np.float32))


def _by_numbers(channel: int, signal: NDArray[np.float32], *, is_float: bool) -> ChannelHealth:
    """Return what PCM tells without a spectrum."""
    changes = float(np.mean(signal[1:] != signal[:-1]))
    level = np.abs(signal)
    peak = float(level.max())
    overload = float(np.mean(level >= (peak if is_float else _FULL)))
    offset = float(np.mean(signal, dtype=np.float64))
    if changes < _STUCK:
        faults: tuple[str, ...] = (f"stuck at {float(np.median(signal)):g}",)
    else:
        full = max(1.0, peak) if is_float else 1.0
        deviation = float(np.std(signal, dtype=np.float64)) / math.sqrt(len(signal))
        most_offset = _OFFSET * full + _OFFSET_DEVIATIONS * deviation
        faults = ("saturated",) * (overload > _SATURATED) + ("offset",) * (abs(offset) > most_offset)
    return ChannelHealth(channel=channel, faults=faults, offset=offset, changes=changes, overload=overload)


def _by_spectra(
    signal_of: Callable[[int], NDArray[np.float32]],
    n_samples: int,
    found: Sequence[ChannelHealth],
    settings: Settings,
) -> tuple[list[ChannelHealth], tuple[float, ...], tuple[str, ...]]:
    """Return the channels with what spectra add, the tones that most of them hear, and what cannot be told."""
    call = settings.call
    size = min(_LONGEST_SEGMENT, 2 ** int(math.log2(n_samples / _SEGMENTS)))
    line_hz = settings.recording.sample_rate_hz / size
    low = round(call.low_frequency_hz / line_hz)
    high = min(round(call.high_frequency_hz / line_hz) + 1, size // 2)
    if not found:
        return [], (), ()
    if high - low < _LEAST_LINES or low < _FIRST_LINE:
        why = f"{n_samples} samples do not resolve the call's band"
        return list(found), (), (f"dead microphones, tones and noise: {why}",)
    spectra = [_bits.spectrogram(signal_of(item.channel), size=size, n_lines=high) for item in found]
    power = np.stack([lines[:, low:].sum(axis=1, dtype=np.float64) for lines in spectra])
    order = np.argsort(np.median(power, axis=0), kind="stable")
    few = max(1, len(order) // 8)
    noise, loud = power[:, order[:few]].mean(axis=1), power[:, order[-few:]].mean(axis=1)
    noise_db = _bits.decibels(noise)
    sensitivity = microphones(settings.array).gain[[item.channel for item in found]]
    sound_db = _bits.decibels(np.maximum(loud - noise, _LEAST_SOUND * loud)) - 20 * np.log10(sensitivity)
    level_db = sound_db - np.median(sound_db)
    unknown: tuple[str, ...] = ()
    if len(found) == 1:
        unknown = ("a dead microphone: there is no other to compare it with",)
    elif np.median(_bits.decibels(loud) - noise_db) < _RISE_DB:
        unknown = ("dead microphones: no sound stands out of the noise",)

    first = max(_FIRST_LINE, math.ceil(_LOWEST_HZ / line_hz))
    # In the mean of decibels a tone, which is always there, outdoes echoes, which come and go.
    rise_db = _bits.rises(np.stack([_bits.decibels(lines[:, first:]).mean(axis=0) for lines in spectra]))
    is_common, common = _bits.common_lines(rise_db, _TONE_DB, _COMMON)
    rise_db[:, is_common] = 0.0
    highest = np.argmax(rise_db, axis=1)
    told = [
        replace(
            item,
            faults=item.faults
            + ("idle tone",) * bool(rise_db[mic, highest[mic]] > _TONE_DB)
            + ("dead",) * bool(not unknown and level_db[mic] < _DEAD_DB),
            level_db=None if unknown else float(level_db[mic]),
            noise_dbfs=float(noise_db[mic]),
            tone_hz=float((first + highest[mic]) * line_hz) if rise_db[mic, highest[mic]] > _TONE_DB else None,
            tone_db=float(rise_db[mic, highest[mic]]),
        )
        for mic, item in enumerate(found)
    ]
    return told, tuple(float((first + line) * line_hz) for line in common), unknown


def _merged(items: Sequence[ChannelHealth]) -> ChannelHealth:
    """Return what several measurements tell of one channel."""
    names = ("offset", "changes", "overload", "level_db", "noise_dbfs")
    figures = {name: _median(getattr(item, name) for item in items) for name in names}
    loudest = max(items, key=lambda item: item.tone_db or 0.0)
    return ChannelHealth(
        channel=items[0].channel,
        faults=tuple(dict.fromkeys(name for item in items for name in item.faults)),
        tone_hz=loudest.tone_hz,
        tone_db=loudest.tone_db,
        **figures,
    )


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _named(channels: Sequence[int], total: int) -> str:
    """Return channels in words, neighbours as from-to."""
    if len(channels) == total:
        return "every channel" if total > 1 else f"channel {channels[0]}"
    ends: list[list[int]] = []
    for channel in channels:
        if ends and channel == ends[-1][1] + 1:
            ends[-1][1] = channel
        else:
            ends.append([channel, channel])
    parts = [str(a) if a == b else f"{a}-{b}" if b > a + 1 else f"{a}, {b}" for a, b in ends]
    return f"channel{'s' * (len(channels) > 1)} {', '.join(parts)}"
