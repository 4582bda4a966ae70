"""Deviations of the microphones from the layout in use, from the strongest echo."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from ertis_numba.calibration import Calibration, calibrate
from ertis_numba.frames import Measurement

__all__ = ["ArrayFinding", "CalibrationResiduals", "calibration_residuals"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayFinding:
    """Fault of an array, as a clause, and its channels; none for a fault of all channels."""

    text: str
    channels: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationResiduals:
    """Deviations from the calibration of the layout in use.

    Attributes
    ----------
    channels : tuple of int
        Channels that were compared.
    delay_s, gain_db : tuple of float
        Deviation of the delay in seconds and of the gain in decibels, for each of these channels.
    delay_sd_s, gain_sd_db : tuple of float
        Standard deviations of these values.
    rms_s : float
        Root mean square deviation of the times of arrival, in seconds.
    findings : tuple of ArrayFinding
        Faults of the array, such as swapped channels.
    """

    channels: tuple[int, ...]
    delay_s: tuple[float, ...]
    gain_db: tuple[float, ...]
    delay_sd_s: tuple[float, ...]
    gain_sd_db: tuple[float, ...]
    rms_s: float
    findings: tuple[ArrayFinding, ...] = ()


def calibration_residuals(measurements: Sequence[Measurement], faulty: Collection[int]) -> CalibrationResiduals:
    """Return the deviations from the layout by a reflector's echo, without ``faulty`` channels."""
    found = calibrate([_without(each, faulty) for each in measurements], target="reflector", position_tolerance_m=0.0)
    return CalibrationResiduals(
        channels=tuple(int(channel) for channel in found.channels),
        delay_s=tuple(found.delay_s.tolist()),
        gain_db=tuple(found.gain_db.tolist()),
        delay_sd_s=tuple(found.delay_sd_s.tolist()),
        gain_sd_db=tuple(found.gain_sd_db.tolist()),
        rms_s=found.residuals.before_s,
        findings=_findings(found),
    )


def _without(measurement: Measurement, channels: Collection[int]) -> Measurement:
    """Return a measurement with further channels disabled."""
    array = measurement.settings.array
    disabled = tuple(sorted({*(array.disabled or ()), *channels}))
    return replace(measurement, settings=measurement.settings.replace(array=array.replace(disabled=disabled)))


def _findings(found: Calibration) -> tuple[ArrayFinding, ...]:
    """Return the findings with their channels, which follow in the order of `Calibration.findings`."""
    channels: list[tuple[int, ...]] = [()] if found.order else []
    channels += [*found.swaps, *((each,) for each in found.inverted)]
    channels += [*found.duplicates.items(), *((each,) for each in found.silent)]
    return tuple(ArrayFinding(text=text, channels=which) for text, which in zip(found.findings, channels, strict=True))
