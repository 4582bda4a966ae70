"""Missing, misplaced and random words within measurements, by the bits of PDM microphones."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from ertis_numba.devices.bits import BitCheck
from ertis_numba.devices.blocks import CHANNELS
from ertis_numba.devices.splice_detection import Splices
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["LostWords", "find_lost_words"]

_MIN_SAMPLES: Final = 2**15  # Shorter records do not show splices.


@dataclass(frozen=True, slots=True, kw_only=True)
class LostWords:
    """Measurements with implausible words.

    Attributes
    ----------
    n_examined : int
        Number of examined measurements.
    reasons : dict of int to str
        Reason of `BitCheck.check` by the index of each measurement with implausible words.
    unknown : str
        Reason why lost words cannot be detected; empty if they can.
    """

    n_examined: int = 0
    reasons: dict[int, str]
    unknown: str = ""


def find_lost_words(measurements: Iterable[tuple[int, Measurement]], settings: Settings) -> LostWords:
    """Find measurements with missing, misplaced or random words; read none if these cannot be found: `BitCheck`."""
    recording, enabled = settings.recording, microphones(settings.array).enabled
    if not recording.is_pdm or len(enabled) != CHANNELS or settings.array.word_bits != CHANNELS:
        return LostWords(reasons={}, unknown=f"it needs PDM of {CHANNELS} microphones")
    if recording.n_samples < _MIN_SAMPLES or not Splices.can_distinguish(recording.sample_rate_hz):
        return LostWords(reasons={}, unknown=f"it needs {_MIN_SAMPLES} samples or more, at 4 MHz or more")
    check = BitCheck(recording.n_samples, recording.sample_rate_hz, enabled, splices=True)
    count, reasons = 0, {}
    for index, measurement in measurements:
        count += 1
        reason = check.check(np.ascontiguousarray(measurement.data, dtype=np.uint32))
        if reason is not None:
            reasons[index] = reason
    return LostWords(n_examined=count, reasons=reasons)
