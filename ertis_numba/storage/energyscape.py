"""Energyscape files: what processing a recording gave, with its axes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Energyscape
from ertis_numba.storage._reader import Reader
from ertis_numba.storage._writer import Writer, self_contained
from ertis_numba.storage.atomic import check_target
from ertis_numba.storage.recording import RecordingReader
from ertis_numba.storage.schema import ENERGYSCAPE, Variable, describe, lay_out

__all__ = ["EnergyscapeReader", "EnergyscapeWriter", "open_energyscapes", "write_energyscapes"]

_AXES = {"azimuth": "azimuth_rad", "elevation": "elevation_rad", "range": "range_m"}


class EnergyscapeWriter(Writer[Energyscape]):
    """Writes energyscapes one by one; use it in a ``with`` statement.

    Parameters
    ----------
    path : str or Path
    recording : RecordingReader, optional
        What they were made from; the file keeps its uuid and SHA-256.
    dtype : {"float32", "float16"}
        float16 halves the file; it keeps three digits down to -84 dB of full scale and fewer below, and
        netCDF programs cannot read it.
    overwrite : bool
        Replace a file of this name.
    """

    _kind: ClassVar[str] = "energyscape"
    _data: ClassVar[str] = "energy"
    _table: ClassVar[tuple[Variable, ...]] = ENERGYSCAPE

    def __init__(
        self,
        path: str | Path,
        *,
        recording: RecordingReader | None = None,
        dtype: Literal["float32", "float16"] = "float32",
        overwrite: bool = False,
    ) -> None:
        checks.choice("dtype", dtype, ("float32", "float16"))
        origin = {"source": "", "history": ""}
        if recording is not None:
            check_target(Path(path), overwrite=overwrite, sources=[recording.path])
            origin = {
                "source": recording.path.name,
                "history": f"processed from recording {recording.uuid}",
                "recording_uuid": recording.uuid,
                "recording_sha256": recording.sha256(),
            }
        super().__init__(path, overwrite=overwrite, attributes=origin)
        self._dtype = np.dtype(dtype).newbyteorder("<").str
        self._first: Energyscape | None = None

    def _begin(self, group: h5py.Group, first: Energyscape) -> None:
        self._first = first
        n_directions, n_ranges = len(first.azimuth_rad), len(first.range_m)
        lay_out(
            group,
            ENERGYSCAPE,
            sizes={"direction": n_directions, "range": n_ranges},
            dtypes={"energy": self._dtype},
            texts={"settings": self_contained(first.settings).to_toml()},
        )
        for name, field in _AXES.items():
            group[name][:] = getattr(first, field)
        describe(group["energy"], {"coordinates": "azimuth elevation"})

    def _row(self, item: Energyscape) -> tuple[NDArray[Any], dict[str, float]]:
        first = self._first
        if first is None or item is first:
            return item.energy, {}
        if item.settings is not first.settings and item.settings != first.settings:
            raise ArgumentError("an energyscape has other settings than the first; write it to its own file")
        for field in _AXES.values():
            ours, theirs = getattr(item, field), getattr(first, field)
            if ours is not theirs and not np.array_equal(ours, theirs):
                raise ArgumentError(f"an energyscape has another {field} than the first; write it to its own file")
        return item.energy, {}


class EnergyscapeReader(Reader[Energyscape]):
    """An energyscape file as a sequence of energyscapes, read one at a time.

    Attributes
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
    range_m : (range,) float64
    """

    _kind: ClassVar[str] = "energyscape"
    _data: ClassVar[str] = "energy"
    _table: ClassVar[tuple[Variable, ...]] = ENERGYSCAPE

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    range_m: NDArray[np.float64]

    def _load(self) -> None:
        for name, field in _AXES.items():
            setattr(self, field, np.asarray(self._group[name][:]))

    def _sizes(self) -> dict[str, int]:
        return {"direction": len(self._group["azimuth"]), "range": len(self._group["range"])}

    def _item(self, index: int) -> Energyscape:
        return Energyscape(
            energy=self._rows.row(index).astype(np.float32, copy=False),
            azimuth_rad=self.azimuth_rad,
            elevation_rad=self.elevation_rad,
            range_m=self.range_m,
            settings=self.settings,
            stamp=self._rows.stamp(index, self.sensor),
        )


def open_energyscapes(path: str | Path, *, sensor: str | None = None) -> EnergyscapeReader:
    """Open an energyscape file for reading.

    Parameters
    ----------
    path : str or Path
    sensor : str, optional
        Which one, where a file holds several.

    Raises
    ------
    DataError
        The file is not an energyscape file, is damaged or cut short.
    FormatVersionError
        A newer version wrote it.
    """
    return EnergyscapeReader(path, sensor=sensor)


def write_energyscapes(
    path: str | Path,
    images: Iterable[Energyscape],
    *,
    recording: RecordingReader | None = None,
    dtype: Literal["float32", "float16"] = "float32",
    overwrite: bool = False,
) -> Path:
    """Write energyscapes as they come and return the path; the arguments are those of `EnergyscapeWriter`.

    Raises
    ------
    ArgumentError
        There is no energyscape, one does not fit to the others, or the file exists.
    DataError
        The disk is full or cannot be written.
    """
    with EnergyscapeWriter(path, recording=recording, dtype=dtype, overwrite=overwrite) as writer:
        for image in images:
            writer.write(image)
    return writer.path
