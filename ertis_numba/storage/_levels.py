"""Scale of 8-bit levels as attributes of CF, which xarray decodes: level = add_offset + scale_factor * code."""

import math
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.frames import Energyscape
from ertis_numba.frames.level_codes import LevelCodes
from ertis_numba.storage.variables import to_python

__all__ = ["encoded", "levels_for", "levels_of", "stored_levels"]

_HEADROOM_DB: Final = 12.0  # of later images
_LEAST_DB: Final = 20.0  # Level of the first image above the floor.


def levels_for(first: Energyscape) -> LevelCodes:
    """Return the scale of the images of a sensor; refuse floating-point samples that are too weak for any."""
    levels, highest = LevelCodes.of(first.amplitude, headroom_db=_HEADROOM_DB), float(first.amplitude.max(initial=0.0))
    if first.settings.recording.encoding == "float32" and 0 < highest < 10 ** ((levels.floor_db + _LEAST_DB) / 20):
        raise ArgumentError(
            f"the first image of sensor {first.stamp.sensor} reaches {20 * math.log10(highest):.1f} dBFS, but 8-bit "
            f"levels begin at {levels.floor_db:g} dBFS; use dtype float32"
        )
    return levels


def encoded(image: Energyscape, levels: LevelCodes) -> NDArray[np.uint8]:
    """Return the codes of an image; refuse amplitudes that have none."""
    try:
        return levels.encode(image.amplitude)
    except ArgumentError as error:
        raise ArgumentError(f"image {image.stamp.sequence} of sensor {image.stamp.sensor}: {error}") from error


def stored_levels(levels: LevelCodes) -> dict[str, Any]:
    """Return the attributes of a scale."""
    return {
        "_FillValue": np.uint8(0),
        "scale_factor": np.float32(levels.step_db),
        "add_offset": np.float32(levels.floor_db - levels.step_db),
    }


def levels_of(dataset: h5py.Dataset, path: Path) -> LevelCodes:
    """Return the scale in the attributes of a dataset; raise DamagedError for any other."""
    step_db, offset_db, fill = (
        to_python(dataset.attrs.get(name)) for name in ("scale_factor", "add_offset", "_FillValue")
    )
    source = f"{path}: {dataset.name}"
    if dataset.dtype != np.uint8 or fill != 0:
        raise DamagedError(f"{source} is {dataset.dtype} with _FillValue {fill}, wanted uint8 with 0; copy it again")
    try:
        levels = LevelCodes.checked(offset_db, step_db, source)
    except DataError as error:
        raise DamagedError(str(error)) from error
    return levels._replace(floor_db=levels.floor_db + levels.step_db)
