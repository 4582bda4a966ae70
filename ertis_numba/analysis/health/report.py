"""State of an array: what the checks report, and its merging over measurements."""

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ertis_numba.analysis.health.kinds import kind_of
from ertis_numba.errors import ArgumentError

__all__ = ["ChannelHealth", "Finding", "Health", "merge"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A fault with the value that shows it.

    Attributes
    ----------
    fault : str
        A name of `ertis_numba.analysis.health.kinds.KINDS`.
    channels : tuple of int
        The channels that have it; of a fault of the record, all that were examined.
    measured : float
        The value, which is beyond the limit.
    limit : float
    detail : str
        More about it, such as the layout that fits.
    """

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
    """State and figures of one microphone; figures that cannot be told are None.

    Attributes
    ----------
    channel : int
        Its bit in the words, counted from 0.
    faults : tuple of str
        Of those in `ertis_numba.analysis.health.kinds.KINDS`; PCM is ``stuck at`` any number.
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
    findings : tuple of Finding
        Each fault of each channel and of the record, with its measured value and its limit.
    not_observable : tuple of str
        Faults that this scene does not show, and why: such as the order of channels without a compact arrival.
    """

    channels: tuple[ChannelHealth, ...]
    measurements: int = 1
    noise_dbfs: float | None = None
    dynamic_range_db: float | None = None
    tones_hz: tuple[float, ...] = ()
    unknown: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    not_observable: tuple[str, ...] = ()

    @property
    def record_faults(self) -> tuple[Finding, ...]:
        """Faults of the whole record rather than of single channels."""
        return tuple(finding for finding in self.findings if kind_of(finding.fault).of_record)

    @property
    def faults(self) -> dict[str, tuple[int, ...]]:
        """The channels of each fault that there is."""
        names = dict.fromkeys(name for item in self.channels for name in item.faults)
        of_channels = {name: tuple(item.channel for item in self.channels if name in item.faults) for name in names}
        return of_channels | {finding.fault: finding.channels for finding in self.record_faults}

    def verdict(self) -> str:
        """Return what is wrong with which channels as a part of a line; it is empty if nothing is."""
        total = len(self.channels)
        return "; ".join(f"{name}: {_named(channels, total)}" for name, channels in self.faults.items())


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
        findings=_worst([finding for report in reports for finding in report.findings]),
        not_observable=tuple(
            text for text in reports[0].not_observable if all(text in report.not_observable for report in reports)
        ),
    )


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


def _worst(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return one finding for each fault and its channels: the one farthest beyond its limit."""
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
