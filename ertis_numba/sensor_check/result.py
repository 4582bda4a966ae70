"""Results of the check of a recording, and its verdict."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ertis_numba.analysis.call_match import CallMatch
from ertis_numba.analysis.health import Health, NotObservable, not_observable_text
from ertis_numba.base.units import counted
from ertis_numba.sensor_check.clock import ClockCheck
from ertis_numba.sensor_check.lost_words import LostWords
from ertis_numba.sensor_check.residuals import CalibrationResiduals
from ertis_numba.settings import Settings
from ertis_numba.storage.verify import SensorReport

__all__ = ["CheckFault", "CheckItem", "RecordingCheck", "SensorCheck"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckFault:
    """Fault of a sensor or of its recording.

    Attributes
    ----------
    check : str
        Name of the check that found the fault.
    text : str
        Fault as a clause, such as ``channel 7 is dead``.
    remedy : str
        Imperative clause.
    """

    check: str
    text: str
    remedy: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckItem:
    """Result of one check.

    Attributes
    ----------
    check : str
        Name of the check.
    result : {"ok", "fault", "not known"}
        ``not known`` if the recording does not show it.
    detail : str
        Measured values, faults, or the reason why the result is not known.
    """

    check: str
    result: Literal["ok", "fault", "not known"]
    detail: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorCheck:
    """Results for one sensor of a recording.

    Attributes
    ----------
    sensor : str
        Name of the sensor.
    settings : Settings
        Settings in use.
    n_microphones : int
        Number of enabled microphones.
    items : tuple of CheckItem
        Result of each check.
    faults : tuple of CheckFault
        All faults.
    examined : tuple of int
        Indices of the measurements whose samples were examined.
    n_passive : int
        Number of measurements without a call.
    stored : SensorReport
        Missing and damaged measurements.
    health : Health or None
        Health of the microphones; None if no measurement can be read.
    words : LostWords
        Measurements with missing, misplaced or random words.
    clock : ClockCheck
        Timing of the measurements.
    call : CallMatch or None
        Match of the call; None if no call was emitted.
    calibration : CalibrationResiduals or None
        Deviations from the layout; None if they are not known.
    """

    sensor: str
    settings: Settings
    n_microphones: int
    items: tuple[CheckItem, ...]
    faults: tuple[CheckFault, ...]
    examined: tuple[int, ...]
    n_passive: int
    stored: SensorReport
    health: Health | None
    words: LostWords
    clock: ClockCheck
    call: CallMatch | None
    calibration: CalibrationResiduals | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingCheck:
    """Results for a recording.

    Attributes
    ----------
    path : Path
        Path of the file.
    sensors : tuple of SensorCheck
        Results for each sensor that can be read.
    unreadable : tuple of CheckFault
        Reasons why the file, or some of its sensors, cannot be read; empty by default.
    """

    path: Path
    sensors: tuple[SensorCheck, ...]
    unreadable: tuple[CheckFault, ...] = ()

    @property
    def faults(self) -> tuple[CheckFault, ...]:
        """All faults; those of one of several sensors begin with its name."""
        several = len(self.sensors) + len(self.unreadable) > 1
        return (
            *self.unreadable,
            *(
                CheckFault(
                    check=fault.check,
                    text=f"sensor {each.sensor}: {fault.text}" if several else fault.text,
                    remedy=fault.remedy.replace("--without ", f"--without {each.sensor}:") if several else fault.remedy,
                )
                for each in self.sensors
                for fault in each.faults
            ),
        )

    @property
    def is_fit(self) -> bool:
        """True if no fault was found."""
        return not self.faults

    @property
    def not_known(self) -> tuple[str, ...]:
        """Names of the checks whose result is not known for some sensor."""
        return tuple(
            dict.fromkeys(item.check for each in self.sensors for item in each.items if item.result == "not known")
        )

    @property
    def not_observable(self) -> tuple[NotObservable, ...]:
        """Faults that the recording cannot show for some sensor, so that the sensor may have them."""
        return tuple(dict.fromkeys(item for each in self.sensors if each.health for item in each.health.not_observable))

    @property
    def verdict(self) -> str:
        """One line with the path, all faults, and their remedies; without faults, those that are not observable."""
        if self.is_fit:
            unknown = f"not known: {', '.join(self.not_known)}" if self.not_known else ""
            hidden = not_observable_text(self.not_observable)
            shown = dict.fromkeys(item.check for each in self.sensors for item in each.items)
            passed = ", ".join(check for check in shown if check not in self.not_known)
            found = f"no fault in {passed}" if hidden else "fit for use"
            return f"{self.path}: {'; '.join(filter(None, (found, unknown, hidden)))}"
        faults = self.faults
        count = counted(len(faults), "fault")
        remedies = "; ".join(dict.fromkeys(fault.remedy for fault in faults))
        return f"{self.path}: {count}: {'; '.join(fault.text for fault in faults)}. Remedy: {remedies}"
