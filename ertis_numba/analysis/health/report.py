"""Health report of an array, and the merging of reports over measurements."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ertis_numba.analysis.health.kinds import kind_of
from ertis_numba.analysis.health.not_observable import NotObservable, in_all, not_observable_text
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.units import runs

__all__ = ["ChannelHealth", "Finding", "Health", "merge"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Fault, by its name in `KINDS`, with the measured value beyond its limit; a record's has all examined channels."""

    fault: str
    channels: tuple[int, ...]
    measured: float
    limit: float
    detail: str = ""

    @property
    def unit(self) -> str:
        """Unit of the measured value and of the limit; empty for shares and counts."""
        return kind_of(self.fault).unit

    @property
    def remedy(self) -> str:
        """Imperative sentence without a full stop."""
        return kind_of(self.fault).remedy


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelHealth:
    """Health of one microphone. Statistics that could not be measured are None, the default.

    Attributes
    ----------
    channel : int
        Channel, counted from 0; for PDM, the bit in the words.
    faults : tuple of str
        Names of faults in `ertis_numba.analysis.health.kinds.KINDS`; empty by default. PCM channels may be ``stuck at``
        any value.
    offset : float or None
        Mean of the bits as −1 and 1, or of PCM samples relative to full scale.
    changes : float or None
        Share of samples that differ from the previous one.
    overload : float or None
        Share of samples at which 17 equal bits start, or of PCM samples at full scale or at a lower level at which they
        are clipped. For float32, full scale is the highest amplitude of the record.
    clip_dbfs : float or None
        Level at which PCM samples are clipped; None unless the channel is saturated.
    level_db : float or None
        Level of the sound in the call's band in the loud eighth of the record, relative to the median of all channels.
        The noise is subtracted, and the calibrated gain is compensated.
    noise_dbfs : float or None
        Noise in the call's band in the quiet eighth of the record: mean square of the signal relative to full scale.
        For float32 samples beyond 1, full scale is the highest amplitude of the record.
    tone_hz, tone_db : float or None
        Frequency of the highest spectral line, if it counts as a tone, and its level relative to the surrounding lines.
        The spectrum is averaged over time and excludes lines that most channels share.
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
    clip_dbfs: float | None = None

    @property
    def state(self) -> str:
        """Names of the faults, ``ok``, or ``unknown`` if the record is too short for any check."""
        return ", ".join(self.faults) or ("ok" if self.offset is not None else "unknown")


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Health of an array.

    Attributes
    ----------
    channels : tuple of ChannelHealth
        Health of the enabled channels.
    measurements : int
        Number of examined measurements; 1 by default.
    noise_dbfs : float or None
        Noise in the call's band, averaged over the channels without fault. Without a call, it is the noise in the bands
        of acoustic maps, and includes the sound of sources.
    dynamic_range_db : float or None
        Full-scale echo of the whole call in every microphone, relative to the noise of the image, in dB; None without a
        call.
    tones_hz : tuple of float
        Frequencies of spectral lines that most channels share; these are not faults of channels.
    unknown : tuple of str
        Checks that no measurement permitted, with the reason.
    findings : tuple of Finding
        All faults of channels and of the record, with measured values and limits.
    not_observable : tuple of NotObservable
        Faults that the recording cannot show, with reason and remedy, such as the order of channels without a compact
        arrival.
    has_call : bool
        True if the sensor emitted its call in any examined measurement.
    """

    channels: tuple[ChannelHealth, ...]
    measurements: int = 1
    noise_dbfs: float | None = None
    dynamic_range_db: float | None = None
    tones_hz: tuple[float, ...] = ()
    unknown: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    not_observable: tuple[NotObservable, ...] = ()
    has_call: bool = True

    @property
    def record_faults(self) -> tuple[Finding, ...]:
        """Faults of the whole record rather than of single channels."""
        return tuple(finding for finding in self.findings if kind_of(finding.fault).of_record)

    @property
    def faults(self) -> dict[str, tuple[int, ...]]:
        """Faulty channels for each fault that was found."""
        names = dict.fromkeys(name for item in self.channels for name in item.faults)
        of_channels = {name: tuple(item.channel for item in self.channels if name in item.faults) for name in names}
        return of_channels | {finding.fault: finding.channels for finding in self.record_faults}

    def verdict(self) -> str:
        """Return a one-line summary of all faults with their channels.

        Without faults, it names what the recording does not show.
        """
        total = len(self.channels)
        found = [f"{name}: {_named(channels, total)}" for name, channels in self.faults.items()]
        if found:
            return "; ".join(found)
        unknown = f"not known: {', '.join(self.unknown)}" if self.unknown else ""
        return "; ".join(filter(None, ("no fault found", unknown, not_observable_text(self.not_observable))))


def merge(reports: Sequence[Health]) -> Health:
    """Merge the health reports, of the same channels, with all faults and the medians of statistics."""
    if not reports:
        raise ArgumentError("reports is empty; pass at least one report")
    first, *others = ([item.channel for item in report.channels] for report in reports)
    if any(other != first for other in others):
        raise ArgumentError("reports have different channels; use reports of one array")
    return Health(
        channels=tuple(_merged(items) for items in zip(*(report.channels for report in reports), strict=True)),
        measurements=sum(report.measurements for report in reports),
        noise_dbfs=_median(report.noise_dbfs for report in reports),
        dynamic_range_db=_median(report.dynamic_range_db for report in reports),
        tones_hz=tuple(sorted({tone_hz for report in reports for tone_hz in report.tones_hz})),
        unknown=tuple(text for text in reports[0].unknown if all(text in report.unknown for report in reports)),
        findings=_worst([finding for report in reports for finding in report.findings]),
        not_observable=in_all([report.not_observable for report in reports]),
        has_call=any(report.has_call for report in reports),
    )


def _merged(items: Sequence[ChannelHealth]) -> ChannelHealth:
    """Return the merged health of one channel."""
    names = ("offset", "changes", "overload", "level_db", "noise_dbfs", "clip_dbfs")
    figures = {name: _median(getattr(item, name) for item in items) for name in names}
    loudest = max(items, key=lambda item: item.tone_db or 0.0)
    return ChannelHealth(
        channel=items[0].channel,
        faults=tuple(dict.fromkeys(name for item in items for name in item.faults)),
        tone_hz=loudest.tone_hz,
        tone_db=loudest.tone_db,
        **figures,
    )


def _worst(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return one finding for each fault and its channels: the one farthest from its limit."""
    worst: dict[tuple[str, tuple[int, ...]], Finding] = {}
    for finding in findings:
        key = finding.fault, finding.channels
        if key not in worst or abs(finding.measured - finding.limit) > abs(worst[key].measured - worst[key].limit):
            worst[key] = finding
    return tuple(worst.values())


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _named(channels: Sequence[int], total: int) -> str:
    """Return a text with the channels, in which consecutive channels form ranges."""
    if len(channels) == total:
        return "every channel" if total > 1 else f"channel {channels[0]}"
    parts = [str(a) if a == b else f"{a}-{b}" if b > a + 1 else f"{a}, {b}" for a, b in runs(channels)]
    return f"channel{'s' * (len(channels) > 1)} {', '.join(parts)}"
