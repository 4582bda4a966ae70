"""Health check of one measurement: all checks in turn, and the report."""

import functools
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis import _bits
from ertis_numba.analysis.health.bits import by_bits
from ertis_numba.analysis.health.kinds import kind_of
from ertis_numba.analysis.health.limits import (
    MAX_OFFSET,
    MAX_SAMPLES,
    MAX_SATURATED,
    MAX_STUCK_NUMBERS,
    MAX_STUCK_SAMPLES,
    MAX_TONE_DB,
    MIN_CHANGES,
    MIN_LEVEL_DB,
    MIN_SAMPLES,
)
from ertis_numba.analysis.health.not_observable import OF_ARRIVAL, NotObservable
from ertis_numba.analysis.health.pcm_samples import by_numbers, scaled, sounding_part, swapped_bytes
from ertis_numba.analysis.health.repeats import duplicates, hum, repeated_blocks, stuck_at_times
from ertis_numba.analysis.health.report import ChannelHealth, Finding, Health
from ertis_numba.analysis.health.spectra import by_spectra
from ertis_numba.analysis.health.wavefront import by_wavefront
from ertis_numba.analysis.sample_faults import (
    MIN_DROPOUT_NUMBERS,
    MIN_DROPOUT_WORDS,
    Parts,
    constant_parts,
    describe_dropouts,
)
from ertis_numba.base import checks
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["health"]

_HUM_BLOCK_S = 1e-3
_DEAF = {"dead", "saturated", "white bits", "duplicate", "stuck at times"}  # These faults hide the received sound.
_LOWEST_NOISE_DBFS = -95.0  # Noise in the call's band; rounding to 16 bits has -106 dBFS.


def health(measurement: Measurement) -> Health:
    """Return the health of the microphones and of the record of one measurement.

    The checks cover the enabled channels and the first 524,288 samples. PCM samples that are exactly 0 in all channels
    at either end of the record are left out, because recorders with a trigger write them. In the loud and the quiet
    eighth of the record, the median channel has the most and the least power in the call's band.

    The dynamic range is ``10 log10(1/2 / noise · B T · N)``: a sine at full scale relative to the noise in the call's
    band, with the gains of matched filter and delay-and-sum. The gain of the matched filter is bandwidth times duration
    (G. L. Turin, An introduction to matched filters, IRE Trans. Inf. Theory 6, 1960). The gain of delay-and-sum is the
    number of microphones without fault. The duration excludes five eighths of each ramp, because a Hann ramp has three
    eighths of the energy.

    A measurement without a call is compared in the bands of ``settings.passive`` instead. It shows neither the dynamic
    range, nor the faults that the wavefront of a call reveals.

    Parameters
    ----------
    measurement : Measurement

    Raises
    ------
    DataError
        The samples do not match the settings.

    Examples
    --------
    Print the faults of an array::

        with ertis.open_recording("data/synthetic/reflectors.h5") as recording:
            report = ertis.health(recording[0])
        print(report.verdict())
    """
    checks.instance("measurement", measurement, Measurement, "a recording contains")
    settings, has_call = measurement.settings, measurement.stamp.behaviour != "passive"
    enabled = np.flatnonzero(microphones(measurement.settings.array).enabled)
    record = sample_format(settings).validated(measurement.data, any_length=True)
    sounding = slice(None) if settings.recording.is_pdm else sounding_part(record, enabled)
    words = record[sounding][:MAX_SAMPLES]
    if len(words) < MIN_SAMPLES:
        too_short = f"the state of any microphone: the record has {len(words)} samples, fewer than {MIN_SAMPLES}"
        return Health(
            channels=tuple(ChannelHealth(channel=int(i)) for i in enabled), unknown=(too_short,), has_call=has_call
        )
    reported, signal_of, whole, columns, half_scale = _recorded_channels(words, record[:MAX_SAMPLES], settings, enabled)
    found = {item.channel: item for item in reported}
    moving = [item for item in reported if not any(name.startswith("stuck") for name in item.faults)]
    band_hz = (
        (settings.call.low_frequency_hz, settings.call.high_frequency_hz)
        if has_call
        else settings.passive.extent_of(settings.recording)
    )
    missing = constant_parts(words, enabled, is_pdm=settings.recording.is_pdm) if moving else []
    reported, tones_hz, unknown, findings = by_spectra(signal_of, len(words), moving, settings, band_hz, missing)
    found |= {item.channel: item for item in reported}
    moved = [(item.channel, columns(item.channel)) for item in moving]
    findings += _by_words(words, moved, found, settings, half_scale, missing)
    findings += _of_dropouts(missing, sounding.start or 0, settings, enabled)
    deaf = {finding.channels[0] for finding in findings if finding.fault in _DEAF}
    heard = [item.channel for item in reported if not set(item.faults) & _DEAF and item.channel not in deaf]
    not_observable = () if has_call else _hidden("no call was emitted", "record with calls")
    if has_call and heard and not any("resolve" in text for text in unknown):
        shown, not_observable = _of_call(measurement, whole, heard, len(record))
        findings += shown
    findings = [*_of_channels(found.values()), *findings]
    channels = _with_faults(found, findings)
    fine = [item for item in channels if not item.faults and item.noise_dbfs is not None]
    noise = [10 ** (item.noise_dbfs / 10) for item in fine if item.noise_dbfs is not None]
    report = Health(
        channels=channels,
        tones_hz=tones_hz,
        unknown=unknown,
        findings=tuple(findings),
        not_observable=not_observable,
        has_call=has_call,
    )
    if not noise:
        return report
    call = settings.call
    noise_dbfs = 10 * math.log10(math.fsum(noise) / len(noise))
    if not has_call:
        return replace(report, noise_dbfs=noise_dbfs)
    duration_s = call.duration_s * (1 - 5 / 4 * call.ramp_fraction)
    gain = (call.high_frequency_hz - call.low_frequency_hz) * duration_s * len(noise)
    dynamic_range_db = 10 * math.log10(gain / 2) - noise_dbfs
    return replace(report, noise_dbfs=noise_dbfs, dynamic_range_db=dynamic_range_db)


class _RecordedChannels(NamedTuple):
    """Channels of a record; ``signal_of`` starts at the first sound, and ``whole`` at the start of the record."""

    reported: list[ChannelHealth]
    signal_of: Callable[[int], NDArray[np.float32]]
    whole: Callable[[int], NDArray[np.float32]]
    columns: Callable[[int], NDArray[Any]]
    half_scale: float


def _recorded_channels(
    words: NDArray[Any], record: NDArray[Any], settings: Settings, enabled: NDArray[np.intp]
) -> _RecordedChannels:
    """Return the channels of a record of bits or of PCM samples, of which ``words`` is the part with sound."""
    if settings.recording.is_pdm:
        octets = _bits.octets_of(words)
        signal_of, columns = functools.partial(_bits.signal_of, octets), functools.partial(_bits.bits_of, octets)
        return _RecordedChannels(by_bits(octets, enabled), signal_of, signal_of, columns, 0.5)
    full, is_float = settings.recording.full_scale, settings.recording.encoding == "float32"
    reported = [by_numbers(i, scaled(words, full, i), is_float=is_float) for i in enabled.tolist()]
    if is_float:  # The unit of float samples may be the pascal.
        full = max(full, *(float(np.abs(words[:, i]).max()) for i in enabled))
    # Times since the start of the record include the silence before its first sound.
    signal_of, whole = functools.partial(scaled, words, full), functools.partial(scaled, record, full)
    return _RecordedChannels(reported, signal_of, whole, functools.partial(_column, words), full)


def _of_call(
    measurement: Measurement, signals: Callable[[int], NDArray[np.float32]], heard: list[int], n_samples: int
) -> tuple[list[Finding], tuple[NotObservable, ...]]:
    """Return the findings from the wavefront of the call, and the faults that it hides: all, if another was emitted."""
    from ertis_numba.analysis.call_match import call_match  # noqa: PLC0415  it uses parts of this package

    settings = measurement.settings
    findings, hidden = by_wavefront(signals, heard, settings, n_samples=min(n_samples, MAX_SAMPLES))
    is_complete = n_samples == settings.recording.n_samples
    if findings and is_complete and call_match(measurement).verdict == "differs":
        return [], _hidden("another call was emitted", "set the call that was emitted (--settings)")
    return findings, hidden


def _hidden(reason: str, remedy: str) -> tuple[NotObservable, ...]:
    return (NotObservable(faults=OF_ARRIVAL, reason=reason, remedy=remedy),)


def _by_words(
    words: NDArray[Any],
    moved: list[tuple[int, NDArray[Any]]],
    found: dict[int, ChannelHealth],
    settings: Settings,
    half_scale: float,
    missing: Parts,
) -> list[Finding]:
    """Return the findings of the checks that need no spectrum."""
    recording, enabled = settings.recording, tuple(found)
    comparable = moved if recording.is_pdm or _have_noise(found.values()) else []
    findings = duplicates(comparable, is_pdm=recording.is_pdm)
    findings += repeated_blocks(words, enabled) if moved else []
    intact = np.ones(len(words), bool)
    for first, stop in missing:
        intact[first:stop] = False
    findings += stuck_at_times(
        [(channel, column[intact]) for channel, column in comparable],
        largest=MAX_STUCK_SAMPLES if recording.is_pdm else MAX_STUCK_NUMBERS,
    )
    steady = [(channel, column) for channel, column in moved if not {"saturated", "offset"} & {*found[channel].faults}]
    block = round(_HUM_BLOCK_S * recording.sample_rate_hz)
    findings += hum(steady, block=block, full_scale=half_scale)
    if recording.encoding == "int16":
        findings += swapped_bytes(words, enabled)
    return findings


def _of_dropouts(missing: Parts, start: int, settings: Settings, enabled: NDArray[np.intp]) -> list[Finding]:
    """Return a finding for the dropouts of a record of which the examined part begins at a sample."""
    if not missing:
        return []
    shifted = [(start + first, start + stop) for first, stop in missing]
    longest = max(stop - first for first, stop in missing)
    limit = MIN_DROPOUT_WORDS if settings.recording.is_pdm else MIN_DROPOUT_NUMBERS
    channels = tuple(enabled.tolist())
    detail = describe_dropouts(shifted)
    return [Finding(fault="dropout", channels=channels, measured=float(longest), limit=float(limit), detail=detail)]


def _with_faults(found: dict[int, ChannelHealth], findings: Iterable[Finding]) -> tuple[ChannelHealth, ...]:
    """Return the channels with the faults of the findings added."""
    named = dict(found)
    for finding in findings:
        for channel in () if kind_of(finding.fault).of_record else finding.channels:
            if finding.fault not in named[channel].faults:
                named[channel] = replace(named[channel], faults=(*named[channel].faults, finding.fault))
    return tuple(named.values())


def _column(words: NDArray[Any], channel: int) -> NDArray[Any]:
    return np.asarray(words[:, channel])


def _have_noise(channels: Iterable[ChannelHealth]) -> bool:
    """Return True if PCM samples contain noise; without noise, a symmetrical array may receive identical echoes."""
    levels = sorted(item.noise_dbfs for item in channels if item.noise_dbfs is not None and not item.faults)
    return bool(levels) and levels[3 * len(levels) // 4] > _LOWEST_NOISE_DBFS


def _of_channels(channels: Collection[ChannelHealth]) -> list[Finding]:
    """Return the findings for the faults in the statistics of channels."""
    measured: dict[str, tuple[str, float]] = {
        "stuck at": ("changes", MIN_CHANGES),
        "stuck in a pattern": ("changes", MIN_CHANGES),
        "saturated": ("overload", MAX_SATURATED),
        "offset": ("offset", MAX_OFFSET),
        "idle tone": ("tone_db", MAX_TONE_DB),
        "dead": ("level_db", MIN_LEVEL_DB),
    }
    return [
        Finding(
            fault=fault,
            channels=(item.channel,),
            measured=float(getattr(item, figure)),
            limit=limit,
            detail="" if fault != "saturated" or item.clip_dbfs is None else f"at {item.clip_dbfs:.1f} dBFS",
        )
        for item in channels
        for fault in item.faults
        for name, (figure, limit) in measured.items()
        if fault == name or (name == "stuck at" and fault.startswith("stuck at "))
    ]
