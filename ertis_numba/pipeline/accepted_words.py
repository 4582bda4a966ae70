"""Words of the measurements that a pipeline or a camera accepts, in the range of single precision."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones, require_plausible_size
from ertis_numba.settings import Air, Array, Call, Recording, Settings

__all__ = ["AcceptedWords", "rescaled"]

_REMEDY: Final = "process it with its own settings (measurement.settings)"


class AcceptedWords:
    """Reader of measurements of the sensor that settings describe, in an array of plausible size."""

    def __init__(self, settings: Settings) -> None:
        require_plausible_size(settings)
        self._settings = self._accepted_settings = settings
        self.format = sample_format(settings)

    def read(self, measurement: Measurement) -> tuple[NDArray[Any], int]:
        """Return the words, scaled into the range of single precision, and the exponent n of the divisor 2^n."""
        self.require_sensor(measurement.settings)
        return self.format.normalised(self.format.validated(measurement.data))

    def require_sensor(self, settings: Settings) -> None:
        """Refuse settings of another sensor; only ``processing`` and ``accuracy`` may differ."""
        if settings is self._accepted_settings:
            return
        for name in ("call", "recording", "air"):
            came, wanted = getattr(settings, name), getattr(self._settings, name)
            if came != wanted:
                raise DataError(f"measurement has {_difference(name, came, wanted)}; {_REMEDY}")
        if settings.array != self._settings.array and not _same_layout(settings.array, self._settings.array):
            raise DataError(
                f"measurement has array {settings.array.layout!r}, but another one, "
                f"{self._settings.array.layout!r}, is in use; {_REMEDY}"
            )
        self._accepted_settings = settings


def _difference(table: str, came: Call | Recording | Air, wanted: Call | Recording | Air) -> str:
    """Return the keys of a table that differ, with both values."""
    pairs = ((name, getattr(came, name), getattr(wanted, name)) for name in came.__struct_fields__)
    return ", ".join(
        f"{table}.{name} {one!r:.60}, but {other!r:.60} is in use" for name, one, other in pairs if one != other
    )


def _same_layout(array: Array, other: Array) -> bool:
    """Return True if two arrays have the same microphones, even if only one is given by its name."""
    came, wanted = microphones(array), microphones(other)
    return came.word_bits == wanted.word_bits and all(
        np.array_equal(getattr(came, name), getattr(wanted, name))
        for name in ("positions_m", "enabled", "gain", "delay_s")
    )


def rescaled(amplitude: NDArray[np.float32], exponent: int) -> NDArray[np.float32]:
    """Return an image multiplied in place by a power of two; raise DataError if it exceeds single precision."""
    if exponent:
        with np.errstate(over="ignore"):
            np.ldexp(amplitude, exponent, out=amplitude)
        if not np.isfinite(amplitude).all():
            raise DataError(
                f"the measurement's samples reach 2^{exponent}, so its image exceeds the largest float32, 3.4e38; "
                "divide the samples by their full scale"
            )
    return amplitude
