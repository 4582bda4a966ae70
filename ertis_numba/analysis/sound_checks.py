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
        self._emissions: list[EmissionTimes | None] = []
        self._remaining: dict[Subject, int] = {"call": _MAX_TRIES, "start": 0, "layout": _MAX_TRIES}

    def check(self, measurement: Measurement) -> list[SoundMismatch]:
        """Return the settings that the sound of the next measurement contradicts.

        Raises
        ------
        DataError
            The samples do not match the settings.
        """
        self._count += 1
        found = []
        for subject in [*self._remaining]:
            warning = self._compare(subject, measurement)
            if warning is None:
                continue
            if warning or subject != "start":
                del self._remaining[subject]
            if warning:
                found.append(SoundMismatch(subject, warning))
            if warning and subject == "call":
                self._remaining.clear()
                break
        return found

    def _compare(self, subject: Subject, measurement: Measurement) -> str | None:
        """Return a warning, empty if the sound agrees; None if this is not known."""
        if subject == "start":
            return self._start(measurement)
        self._remaining[subject] -= 1
        if subject == "call":
            call = call_match(measurement)
            known = None if call is None else call.warning or call.note
        else:
            layout = layout_match(measurement)
            known = None if layout is None else layout.warning
        return "" if known is None and not self._remaining[subject] else known

    def _start(self, measurement: Measurement) -> str | None:
        """Compare the direct sound with the distance of the emitter, in ever fewer measurements."""
        if self._count & (self._count - 1):
            return None
        self._emissions.append(emissions_of(measurement))
        settings = measurement.settings
        shift = describe_start(self._emissions, sound_speed_m_s(settings.air), delay_s=settings.call.delay_s)
        return "" if shift is None else "; ".join(shift)
