"""Comparison of a sensor's sound with its settings: the call, the start of the record, and the layout; lost samples."""

from typing import Final, Literal, NamedTuple

from ertis_numba.analysis.call_match import SILENT, call_match
from ertis_numba.analysis.emission_time import EmissionTimes, describe_start, emissions_of
from ertis_numba.analysis.layout_match import layout_match
from ertis_numba.analysis.sample_faults import SampleFaults
from ertis_numba.frames import Measurement
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["SoundChecks", "SoundMismatch", "Subject"]

Subject = Literal["call", "start", "layout", "samples"]
_MAX_TRIES: Final = 8  # Measurements that are compared with call and layout, if they contain no sound.


class SoundMismatch(NamedTuple):
    """Setting that the sound contradicts, and a warning of one line."""

    subject: Subject
    warning: str


class SoundChecks:
    """Checks of the measurements of one sensor, each of which reports at most one mismatch."""

    # Call and layout are compared in at most 8 measurements, until known; the start of the record in numbers 1, 2, 4, 8
    # and so on if `thinned`. Another call ends all checks.

    def __init__(self, *, thinned: bool = True, live: bool = False) -> None:
        self._thinned, self._count = thinned, 0
        self._faults: SampleFaults | None = SampleFaults(copies=live)
        self._is_other_call = self._is_shifted = self._is_noted = False
        self._emissions: list[EmissionTimes | None] = []
        self._tries: dict[Literal["call", "layout"], int] = {"call": _MAX_TRIES, "layout": _MAX_TRIES}

    def check(self, measurement: Measurement) -> list[SoundMismatch]:
        """Return the settings that the sound of the next measurement contradicts."""
        self._count += 1
        lost = SoundMismatch("samples", self._samples(measurement))
        if self._is_other_call:
            return [lost] if lost.warning else []
        found = [lost, SoundMismatch("call", self._call(measurement))]
        if not self._is_other_call:
            found.append(SoundMismatch("start", self._start(measurement)))
            found.append(SoundMismatch("layout", self._layout(measurement)))
        return [each for each in found if each.warning]

    def _samples(self, measurement: Measurement) -> str:
        """Return a warning at the first dropout or copy."""
        if self._faults is None:
            return ""
        self._faults.add(measurement)
        note = self._faults.note()
        if note:
            self._faults = None
        return note

    def _call(self, measurement: Measurement) -> str:
        """Return a warning if the sound contradicts the call, or a note if it may."""
        if not self._tries["call"]:
            return ""
        match = call_match(measurement)
        self._tries["call"] -= 1
        if match.verdict != "unknown":
            self._tries["call"] = 0
            self._is_other_call = match.verdict == "differs"
            return match.warning
        if match is SILENT or self._is_noted:
            return ""
        self._is_noted = True
        return match.warning

    def _layout(self, measurement: Measurement) -> str:
        """Return a warning if the sound contradicts the layout."""
        if not self._tries["layout"]:
            return ""
        layout = layout_match(measurement)
        self._tries["layout"] = 0 if layout is not None else self._tries["layout"] - 1
        return "" if layout is None else layout.warning

    def _start(self, measurement: Measurement) -> str:
        """Compare the direct sound with the distance of the emitter, in ever fewer measurements."""
        if self._is_shifted or (self._thinned and self._count & (self._count - 1)):
            return ""
        self._emissions.append(emissions_of(measurement))
        settings = measurement.settings
        shift = describe_start(self._emissions, sound_speed_m_s(settings.air), delay_s=settings.call.delay_s)
        self._is_shifted = shift is not None
        return "; ".join(shift or ())
