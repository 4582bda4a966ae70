"""Comparison of a sensor's sound with its settings: the call, the start of the record, and the layout."""

from typing import Final, Literal, NamedTuple

from ertis_numba.air import sound_speed_m_s
from ertis_numba.analysis.call_match import call_match
from ertis_numba.analysis.emission_time import EmissionTimes, describe_start, emissions_of
from ertis_numba.analysis.layout_match import layout_match
from ertis_numba.frames import Measurement

__all__ = ["SoundChecks", "SoundMismatch", "Subject"]

Subject = Literal["call", "start", "layout"]
_MAX_TRIES: Final = 8  # Measurements that are compared with call and layout, if they contain no sound.


class SoundMismatch(NamedTuple):
    """Setting that the sound contradicts, and a warning of one line."""

    subject: Subject
    warning: str


class SoundChecks:
    """Checks of the measurements of one sensor, each of which reports at most one mismatch.

    Call and layout are compared until a measurement has sound above the noise, in at most 8 measurements. The start of
    the record may change later, so that it is compared in measurements 1, 2, 4, 8 and so on. Another call ends all
    checks, because its filter does not find the times of arrival.
    """

    def __init__(self) -> None:
        self._count = 0
        self._is_other_call = self._is_shifted = False
        self._emissions: list[EmissionTimes | None] = []
        self._tries: dict[Literal["call", "layout"], int] = {"call": _MAX_TRIES, "layout": _MAX_TRIES}

    def check(self, measurement: Measurement) -> list[SoundMismatch]:
        """Return the settings that the sound of the next measurement contradicts.

        Raises
        ------
        DataError
            The samples do not match the settings.
        """
        self._count += 1
        found: list[SoundMismatch] = []
        if self._is_other_call:
            return found
        if warning := self._compare("call", measurement):
            self._is_other_call = True
            return [SoundMismatch("call", warning)]
        if warning := self._start(measurement):
            self._is_shifted = True
            found.append(SoundMismatch("start", warning))
        if warning := self._compare("layout", measurement):
            found.append(SoundMismatch("layout", warning))
        return found

    def _compare(self, subject: Literal["call", "layout"], measurement: Measurement) -> str:
        """Return a warning if the sound contradicts the call or the layout; ask no more once it has been known."""
        if not self._tries[subject]:
            return ""
        self._tries[subject] -= 1
        if subject == "call":
            call = call_match(measurement)
            known = None if call is None else call.warning or call.note
        else:
            layout = layout_match(measurement)
            known = None if layout is None else layout.warning
        if known is not None:
            self._tries[subject] = 0
        return known or ""

    def _start(self, measurement: Measurement) -> str:
        """Compare the direct sound with the distance of the emitter, in ever fewer measurements."""
        if self._is_shifted or self._count & (self._count - 1):
            return ""
        self._emissions.append(emissions_of(measurement))
        settings = measurement.settings
        shift = describe_start(self._emissions, sound_speed_m_s(settings.air), delay_s=settings.call.delay_s)
        return "" if shift is None else "; ".join(shift)
