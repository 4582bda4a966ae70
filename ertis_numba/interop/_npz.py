"""Energyscapes as NPZ: a ZIP archive of NumPy arrays, readable without pickle.

The files follow NEP 1 (A simple file format for NumPy arrays), like those of `numpy.savez`.
"""

import itertools
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import self_contained

__all__ = ["write_npz"]

_STAMPS = ("session_id", "sequence", "sync_count", "timestamp_ns", "timestamp_uncertainty_ns")
_AXES = ("azimuth_rad", "elevation_rad", "range_m")


def write_npz(path: Path, images: Iterable[Energyscape], count: int | None) -> None:
    """Write the images of one sensor; one at a time if ``count`` is given, otherwise collect them first.

    The amplitudes have the shape (time, direction, range), and the fields of the stamps (time,). The axes, and sensor
    and settings as texts, follow.

    Raises
    ------
    ArgumentError
        Sensor, axes or settings of an image differ from those of the first, or their number differs from ``count``.
    """
    if count is None:
        gathered = list(images)
        images, count = gathered, len(gathered)
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open("amplitude.npy", "w", force_zip64=True) as member:
            first, stamps = _write_amplitude(member, images, count)
        arrays: dict[str, Any] = {name: getattr(first, name) for name in _AXES}
        arrays |= {name: np.array([getattr(stamp, name) for stamp in stamps], dtype=np.int64) for name in _STAMPS}
        arrays["sensor"] = np.array(first.stamp.sensor)
        arrays["settings"] = np.array(self_contained(first.settings).to_toml())
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _write_amplitude(file: IO[bytes], images: Iterable[Energyscape], count: int) -> tuple[Energyscape, list[Stamp]]:
    """Write a row for each image; return the first one and the stamps of all."""
    rest = iter(images)
    first = next(rest)
    shape = (count, *first.amplitude.shape)
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    stamps = []
    for image in itertools.chain([first], rest):
        _require_same(image, first)
        file.write(np.ascontiguousarray(image.amplitude, dtype="<f4").data.cast("B"))
        stamps.append(image.stamp)
    if len(stamps) != count:
        raise ArgumentError(f"{len(stamps)} energyscapes were given, but count is {count}; give as many")
    return first, stamps


def _require_same(image: Energyscape, first: Energyscape) -> None:
    """Refuse an image whose axes or settings differ from the first."""
    if image.stamp.sensor != first.stamp.sensor:
        raise ArgumentError(
            f"sensors {first.stamp.sensor} and {image.stamp.sensor} cannot share the axes of one npz; choose one "
            "(--sensor)"
        )
    for name in _AXES:
        if not np.array_equal(getattr(image, name), getattr(first, name)):
            raise ArgumentError(
                f"measurement {image.stamp.sequence} has another {name} than the first, for example because of other "
                "air; export it to its own npz (--measurement)"
            )
    if image.settings is not first.settings and image.settings != first.settings:
        raise ArgumentError(
            f"measurement {image.stamp.sequence} has other settings than the first; export it to its own npz "
            "(--measurement)"
        )
