"""Energyscapes, beams and microphone signals as NPZ: a ZIP archive of NumPy arrays, readable without pickle.

The files follow NEP 1 (A simple file format for NumPy arrays), like those of `numpy.savez`.
"""

import itertools
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Beams, Energyscape, MicrophoneSignals, Stamp
from ertis_numba.geometry import observable_angles, self_contained

__all__ = ["Result", "write_npz"]

Result: TypeAlias = Energyscape | Beams | MicrophoneSignals
"""Result of a stage of processing."""

_STAMPS = ("session_id", "sequence", "sync_count", "timestamp_ns", "timestamp_uncertainty_ns")
_ANGLES = ("azimuth_rad", "elevation_rad")
_AXES = (*_ANGLES, "range_m")
_SIGNAL_AXES = ("time_s", "positions_m", "delay_s")


def write_npz(path: Path, results: Iterable[Result], count: int | None) -> None:
    """Write the results of one sensor; one at a time if ``count`` is given, otherwise collect them first."""
    # Samples are (time, direction, range) or (time, microphone, sample). Unobserved angles are NaN.
    if count is None:
        gathered = list(results)
        results, count = gathered, len(gathered)
    rest = iter(results)
    first = next(rest)
    name, axes = _content(first)
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            stamps = _write_samples(member, itertools.chain([first], rest), first, count)
        arrays: dict[str, Any] = {axis: getattr(first, axis) for axis in axes}
        if not any(observable_angles(first.settings.array)[:2]):
            arrays |= {axis: np.full_like(arrays[axis], np.nan) for axis in _ANGLES if axis in axes}
        arrays |= {field: np.array([getattr(stamp, field) for stamp in stamps], dtype=np.int64) for field in _STAMPS}
        arrays["behaviour"] = np.array([stamp.behaviour for stamp in stamps])
        if isinstance(first, Energyscape) and first.level_step_db:
            arrays["level_step_db"] = np.array(first.level_step_db)
        arrays["sensor"] = np.array(first.stamp.sensor)
        arrays["settings"] = np.array(self_contained(first.settings).to_toml())
        for field, array in arrays.items():
            with archive.open(f"{field}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _content(result: Result) -> tuple[str, tuple[str, ...]]:
    """Return the names of the samples of a result and of their axes."""
    if isinstance(result, Energyscape):
        return "amplitude", _AXES
    if isinstance(result, Beams):
        return "beam", _AXES
    return "demodulated" if result.settings.processing.last_stage == "demodulation" else "matched", _SIGNAL_AXES


def _write_samples(file: IO[bytes], results: Iterable[Result], first: Result, count: int) -> list[Stamp]:
    """Write a row for each result; return the stamps of all."""
    name, _ = _content(first)
    samples = getattr(first, name)
    kind = samples.dtype.newbyteorder("<")
    header = {"descr": kind.str, "fortran_order": False, "shape": (count, *samples.shape)}
    np.lib.format.write_array_header_1_0(file, header)
    stamps = []
    for result in results:
        _require_same(result, first)
        file.write(np.ascontiguousarray(getattr(result, name), dtype=kind).data.cast("B"))
        stamps.append(result.stamp)
    if len(stamps) != count:
        raise ArgumentError(f"{len(stamps)} results were passed, but count is {count}; pass as many results")
    return stamps


def _require_same(result: Result, first: Result) -> None:
    """Refuse a result whose type, axes or settings differ from the first."""
    if type(result) is not type(first):
        raise ArgumentError(
            f"{type(first).__name__} and {type(result).__name__} cannot share one npz; pass results of one stage"
        )
    if result.stamp.sensor != first.stamp.sensor:
        raise ArgumentError(
            f"sensors {first.stamp.sensor} and {result.stamp.sensor} cannot share the axes of one npz; choose one "
            "(sensor)"
        )
    for name in _content(first)[1]:
        if not np.array_equal(getattr(result, name), getattr(first, name)):
            raise ArgumentError(
                f"measurement {result.stamp.sequence} has another {name} than the first, for example because of other "
                "air; export it to its own npz (measurement)"
            )
    if result.settings is not first.settings and result.settings != first.settings:
        raise ArgumentError(
            f"measurement {result.stamp.sequence} has other settings than the first; export it to its own npz "
            "(measurement)"
        )
