"""Comparison of echoes with the layout of the settings, which determines the directions in images."""

import functools
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from ertis_numba.analysis import _bits
from ertis_numba.analysis.health import ARRAY_FAULTS, Finding, Health
from ertis_numba.analysis.health.limits import MAX_SAMPLES, MIN_SAMPLES
from ertis_numba.analysis.health.not_observable import OF_ARRIVAL
from ertis_numba.analysis.health.pcm_samples import scaled
from ertis_numba.analysis.health.wavefront import by_array
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["LayoutMatch", "first_layout_match", "layout_match"]

_MAX_MEASUREMENTS: Final = 8
_MIN_MICS: Final = 3  # Fewer show no layout.
_MAX_MICS: Final = 48


@dataclass(frozen=True, slots=True)
class LayoutMatch:
    """Comparison of the strongest sound with the layout, and another order, size or timing that fits far better."""

    finding: Finding | None

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "LayoutMatch":
        """Return the match that findings of a health report describe."""
        return cls(next((each for each in findings if each.fault in ARRAY_FAULTS), None))

    @classmethod
    def of_report(cls, report: Health, settings: Settings) -> "LayoutMatch | None":
        """Return the match in a report that compared the same channels as `layout_match` does; None for another one."""
        found = cls.of(report.findings)
        has_arrival = not any(set(OF_ARRIVAL) <= {*each.faults} for each in report.not_observable)
        is_whole = settings.recording.is_pdm and _MIN_MICS <= len(report.channels) <= _MAX_MICS and not report.unknown
        is_same = is_whole and has_arrival and not any(channel.faults for channel in report.channels)
        return found if found.warning or is_same else None

    @property
    def warning(self) -> str:
        """One-line warning; empty if the layout may be right."""
        if self.finding is None:
            return ""
        return (
            f"echoes do not match the layout of the settings ({self.finding.fault}: {self.finding.detail}). Directions "
            f"are wrong; {self.finding.remedy}"
        )


def first_layout_match(measurements: Iterable[Measurement]) -> LayoutMatch | None:
    """Return the match of the first measurement with an arrival; None if the first 8 contain none."""
    for measurement in itertools.islice(measurements, _MAX_MEASUREMENTS):
        found = layout_match(measurement)
        if found is not None:
            return found
    return None


def layout_match(measurement: Measurement) -> LayoutMatch | None:
    """Compare the strongest arrival with the layout, and with other orders, sizes and timings; None for no arrival."""
    settings = measurement.settings
    channels = np.flatnonzero(microphones(settings.array).enabled)
    if len(channels) < _MIN_MICS:
        return LayoutMatch.of(())
    if len(channels) > _MAX_MICS:  # At random, because every second one could hide an order.
        channels = np.sort(np.random.default_rng(0).choice(channels, _MAX_MICS, replace=False))
    words = sample_format(settings).validated(measurement.data)[:MAX_SAMPLES]
    if len(words) < MIN_SAMPLES:
        return None
    signals: Callable[[int], NDArray[np.float32]]
    if settings.recording.is_pdm:
        signals = functools.partial(_bits.signal_of, _bits.octets_of(words))
    else:
        full = max(settings.recording.full_scale, float(np.abs(words[:, channels].astype(np.float64)).max()))
        signals = functools.partial(scaled, words, full)
    findings = by_array(signals, channels.tolist(), settings, n_samples=len(words))
    return None if findings is None else LayoutMatch.of(findings)
