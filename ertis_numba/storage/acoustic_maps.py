"""Files of acoustic maps: sound power over direction and band, with their axes."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.angles import DegreesFromRadians
from ertis_numba.atomic_files import check_target
from ertis_numba.errors import ArgumentError, DamagedError
from ertis_numba.frames import AcousticMap
from ertis_numba.geometry import mounting as mounted, self_contained
from ertis_numba.storage._mounting import read_mounting, write_mounting
from ertis_numba.storage._provenance import provenance, recorded_mountings
from ertis_numba.storage._reader import FileReader
from ertis_numba.storage._writer import FileWriter
from ertis_numba.storage.recording import Mounting, RecordingReader
from ertis_numba.storage.schema import ACOUSTIC_MAP, Variable, create_variables, set_attributes

__all__ = ["AcousticMapReader", "AcousticMapWriter", "open_acoustic_maps", "write_acoustic_maps"]

_AXES = {"azimuth": "azimuth_rad", "elevation": "elevation_rad", "band_edge": "band_hz"}


class AcousticMapWriter(FileWriter[AcousticMap]):
    """Writer of a file of acoustic maps, one map at a time; use it in a ``with`` statement.

    Maps of several sensors may come in any order.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    recording : RecordingReader or sequence of RecordingReader, optional
        Recording of the maps: one reader, or one for each sensor of the same recording. The file stores its UUID and
        SHA-256.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting by name of the sensor, as for `RecordingWriter`, instead of that of the recording. By default, the file
        stores the mountings that the recording contains.
    overwrite : bool
        Replace an existing file.
    """

    _kind: ClassVar[str] = "acoustic_map"
    _data: ClassVar[str] = "power"
    _table: ClassVar[tuple[Variable, ...]] = ACOUSTIC_MAP
    _numbered: ClassVar[bool] = False

    def __init__(
        self,
        path: str | Path,
        *,
        recording: RecordingReader | Sequence[RecordingReader] | None = None,
        mounting: Mapping[str, Mounting] | None = None,
        overwrite: bool = False,
    ) -> None:
        readers = [recording] if isinstance(recording, RecordingReader) else [*(recording or ())]
        check_target(Path(path), overwrite=overwrite, sources=[reader.path for reader in readers])
        super().__init__(path, overwrite=overwrite, attributes=provenance(readers), truth=None)
        self._first: dict[str, AcousticMap] = {}
        self._given = {sensor: mounted(sensor, *given) for sensor, given in (mounting or {}).items()}
        self._mounting = recorded_mountings(readers) | self._given

    def _begin(self, group: h5py.Group, first: AcousticMap) -> None:
        self._first[first.stamp.sensor] = first
        n_directions, n_bands = first.power.shape
        create_variables(
            group,
            ACOUSTIC_MAP,
            sizes={"direction": n_directions, "band": n_bands, "edge": 2},
            dtypes={"power": "<f4"},
            texts={"settings": self_contained(first.settings).to_toml()},
        )
        write_mounting(group, self._mounting.get(first.stamp.sensor, {}))
        for name, field in _AXES.items():
            group[name][:] = getattr(first, field)
        set_attributes(group["power"], {"coordinates": "azimuth elevation"})

    def _row(self, item: AcousticMap) -> tuple[NDArray[Any], dict[str, float]]:
        first = self._first[item.stamp.sensor]
        if item.settings is not first.settings and item.settings != first.settings:
            raise ArgumentError("settings of an acoustic map differ from those of the first; write it to another file")
        for field in _AXES.values():
            if not np.array_equal(getattr(item, field), getattr(first, field)):
                raise ArgumentError(
                    f"{field} of an acoustic map differs from that of the first; write it to another file"
                )
        counts = {"n_measurements": item.n_measurements, "n_blocks": item.n_blocks}
        return item.power, {**counts, "masked": item.masked_s}

    def _finish(self, file: h5py.File) -> None:
        super()._finish(file)
        self._require_sensors("mounting", self._given)


class AcousticMapReader(FileReader[AcousticMap], DegreesFromRadians):
    """File of acoustic maps as a sequence of them, each read when it is indexed.

    The properties ``azimuth_deg`` and ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame, in radians.
    band_hz : (band, 2) float64
        Lower and upper edge of each band in hertz.
    n_measurements : (map,) int64
        Measurements in each map.
    translation_m : (3,) float64, or None
        Position of the sensor in metres; None if its mounting is unknown.
    rotation_xyzw : (4,) float64, or None
        Unit quaternion that rotates the sensor frame into the platform frame; None if the mounting is unknown.
    """

    _kind: ClassVar[str] = "acoustic_map"
    _wanted: ClassVar[str] = "a file of acoustic maps"
    _data = "power"
    _table = ACOUSTIC_MAP

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    band_hz: NDArray[np.float64]
    n_measurements: NDArray[np.int64]
    translation_m: NDArray[np.float64] | None
    rotation_xyzw: NDArray[np.float64] | None

    def _load(self) -> None:
        for name, field in _AXES.items():
            setattr(self, field, np.asarray(self._group[name][:]))
        self.n_measurements = np.asarray(self._group["n_measurements"][:])
        self.translation_m, self.rotation_xyzw = read_mounting(self._group, self.path)

    def _sizes(self) -> dict[str, int]:
        return {"direction": len(self._group["azimuth"]), "band": len(self._group["band_edge"]), "edge": 2}

    def _item(self, index: int) -> AcousticMap:
        try:
            return AcousticMap(
                power=self._rows.row(index).astype(np.float32, copy=False),
                azimuth_rad=self.azimuth_rad,
                elevation_rad=self.elevation_rad,
                band_hz=self.band_hz,
                settings=self.settings,
                stamp=self._rows.stamp(index, self.sensor),
                n_measurements=int(self.n_measurements[index]),
                n_blocks=self._rows.column("n_blocks", index),
                masked_s=self._rows.column("masked", index),
            )
        except ArgumentError as error:
            raise DamagedError(f"{self.path}: acoustic map {index}: {error}") from error


def open_acoustic_maps(path: str | Path, *, sensor: str | None = None) -> AcousticMapReader:
    """Open a file of acoustic maps for reading.

    Parameters
    ----------
    path : str or Path
    sensor : str, optional
        Name of the sensor, if the file contains several.

    Returns
    -------
    AcousticMapReader

    Raises
    ------
    DataError
        The file does not contain acoustic maps, is damaged or truncated.
    FormatVersionError
        A newer version wrote the file.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     maps = list(ertis.AcousticCamera(recording.settings).process_many(recording))
    >>> path = ertis.write_acoustic_maps("maps.h5", maps, overwrite=True)
    >>> with ertis.open_acoustic_maps(path) as reader:
    ...     len(reader) == len(maps)
    True
    """
    return AcousticMapReader(path, sensor=sensor)


def write_acoustic_maps(
    path: str | Path,
    maps: Iterable[AcousticMap],
    *,
    recording: RecordingReader | Sequence[RecordingReader] | None = None,
    mounting: Mapping[str, Mounting] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a file of acoustic maps.

    Parameters
    ----------
    path : str or Path
    maps : iterable of AcousticMap
        Maps of one or several sensors. It is read one map at a time.
    recording, mounting, overwrite
        See `AcousticMapWriter`.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ArgumentError
        There is no map, settings or axes of a sensor's maps differ, or the file exists.
    DataError
        The disk is full or cannot be written.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     path = ertis.write_acoustic_maps("maps.h5", camera.process_many(recording), overwrite=True)
    """
    with AcousticMapWriter(path, recording=recording, mounting=mounting, overwrite=overwrite) as writer:
        for each in checks.items("maps", maps, AcousticMap, "AcousticCamera.process returns"):
            writer.write(each)
    return writer.path
