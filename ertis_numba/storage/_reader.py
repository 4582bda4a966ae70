"""Base class of the readers of files with one row per measurement."""

import hashlib
import operator
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from os import PathLike
from pathlib import Path
from typing import ClassVar, Self, TypeVar, overload

import h5py

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, FormatVersionError
from ertis_numba.base.file_kinds import kind_of, problem_of, quoted
from ertis_numba.frames import Stamp
from ertis_numba.geometry import received_settings
from ertis_numba.storage._rows import RowReader
from ertis_numba.storage.opening import RESULT_OR_RECORDING, Source, open_binary, open_file, reading
from ertis_numba.storage.schema import FORMAT_VERSION, OLDEST_VERSION, Variable, content_sha256
from ertis_numba.storage.structure import local_member, require_attributes, require_variables, sensors_of
from ertis_numba.storage.truth import GroundTruth, read_truth
from ertis_numba.storage.variables import to_python

__all__ = ["FileReader", "file_kind", "sensor_names"]

Item = TypeVar("Item")
_OPTIONAL_DIMS = {"word"}  # The axis is left out if its length is one.
_MAX_NAMES = 64  # Limit on sensors in an error.
_KIND_NAMES = {
    "recording": "a recording",
    "energyscape": "an energyscape file",
    "acoustic_map": "a file of acoustic maps",
}


def file_kind(path: str | Path, wanted: str = RESULT_OR_RECORDING) -> str:
    """Return ``recording``, ``energyscape`` or ``acoustic_map``; errors name the kinds of file that are wanted."""
    with open_file(Path(path), wanted) as file:
        return _kind(file, Path(path), wanted)


def sensor_names(path: Source, wanted: str = RESULT_OR_RECORDING) -> tuple[str, ...]:
    """Return the names of the sensors in a recording or a result of processing, in the order of the file.

    Raises
    ------
    DataError
        The file cannot be read, or is of another kind.
    """
    place = _place(path)
    with _opened(path, wanted) as file, reading(file, place):
        _kind(file, place, wanted)
        return sensors_of(file)


class FileReader(Sequence[Item]):
    """File with one row per measurement, as a sequence that reads a row on access; slices are lists.

    Close it after use, or use it in a ``with`` statement.

    Attributes
    ----------
    path : Path
        Path of the file, or the name of the file object.
    sensor : str
        Sensor of these rows.
    sensors : tuple of str
        All sensors in the file, in its order.
    settings : Settings
        Settings of the sensor, independent of other files.
    truth : GroundTruth or None
        Ground truth of simulated measurements; None if unknown.
    attributes : dict
        Attributes of the file: uuid, source, date_created and others.
    """

    _kind: ClassVar[str]
    _row_name: ClassVar[str] = "measurement"
    _data: str
    _table: tuple[Variable, ...]

    def __init__(self, path: Source, *, sensor: str | None = None) -> None:
        self.path = _place(path)
        self._binary = None if isinstance(path, str | PathLike) else path
        self._file = _opened(path, _KIND_NAMES[self._kind])
        try:
            with self._reading():
                self._require_kind()
                self.sensors: tuple[str, ...] = sensors_of(self._file)
                self.sensor = self._select_sensor(sensor)
                self._group = local_member(self._file["sensors"], self.sensor, h5py.Group)
                self._select_table()
                self._require_variables()
                self._rows = RowReader(self._group, self._data, self._row_name)
                self.attributes = _attributes(self._file)
                self.settings = received_settings(
                    self._group["settings"][()], f"{self.path}: settings", are_applied=self._kind != "recording"
                )
                self._require_shapes()
                self._load()
                self._require_content()
                self.truth: GroundTruth | None = read_truth(self._group)
        except BaseException:
            self._file.close()
            raise

    def _select_table(self) -> None:
        """Choose the table of variables, if the kind of file has several."""

    @abstractmethod
    def _item(self, index: int) -> Item:
        """Return one row as a measurement, an energyscape or an acoustic map."""

    @abstractmethod
    def _load(self) -> None:
        """Read the parts that only one kind of file has."""

    @abstractmethod
    def _sizes(self) -> dict[str, int]:
        """Return the length of each axis, from the settings or from the file."""

    @property
    def uuid(self) -> str:
        """Identity of the content: files with the same identity have the same content."""
        return str(self.attributes.get("uuid", ""))

    def sha256(self) -> str:
        """Return the SHA-256 of the file, in hexadecimal."""
        if self._binary is None:
            with self.path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        digest = hashlib.sha256()
        self._binary.seek(0)
        while block := self._binary.read(2**20):
            digest.update(block)
        return digest.hexdigest()

    def stamps(self) -> list[Stamp]:
        """Return the stamps of all measurements, without reading the measurements."""
        with self._reading():
            return self._rows.stamps(self.sensor)

    @property
    def points_note(self) -> str | None:
        """Note on fused images without points; None for other files."""
        return None

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Item: ...

    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...

    def __getitem__(self, index: int | slice) -> Item | list[Item]:
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path} has no {self._row_name} {index}; it has {len(self)}, counted from 0")
        with self._reading():
            return self._item(index % len(self))

    def __iter__(self) -> Iterator[Item]:
        return (self[index] for index in range(len(self)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; closing twice is harmless."""
        self._file.close()

    def _reading(self) -> AbstractContextManager[None]:
        return reading(self._file, self.path)

    def _require_kind(self) -> None:
        kind = _kind(self._file, self.path, _KIND_NAMES[self._kind])
        if kind != self._kind:
            raise DataError(
                f"{self.path} is {_KIND_NAMES[kind]}, wanted {_KIND_NAMES[self._kind]}; {self._remedy(kind)}"
            )

    def _remedy(self, kind: str) -> str:
        """Return the way from a file of another kind to one that can be read here."""
        command = "process" if self._kind == "energyscape" else "acoustic"
        if self._kind == "recording":
            return "use the recording from which it was made"
        if kind == "recording":
            return f"process it first ('ertis {command} {quoted(self.path)}')"
        return f"process the recording from which it was made ('ertis {command} RECORDING')"

    def _select_sensor(self, sensor: str | None) -> str:
        names = ", ".join(self.sensors[:_MAX_NAMES]) + ", …" * (len(self.sensors) > _MAX_NAMES)
        if sensor is None and len(self.sensors) != 1:
            raise ArgumentError(f"{self.path} contains {len(self.sensors)} sensors; choose one of {names} (sensor)")
        if sensor is not None and sensor not in self.sensors:
            raise ArgumentError(f"{self.path} has no sensor {sensor!r}; choose one of {names}")
        return self.sensors[0] if sensor is None else sensor

    def _require_variables(self) -> None:
        missing = [
            variable.name for variable in self._table if not variable.optional and variable.name not in self._group
        ]
        if missing:
            raise DamagedError(f"{self.path} has no {missing[0]!r} for sensor {self.sensor}; copy it again")
        require_variables(self._group, self._table)

    def _require_shapes(self) -> None:
        sizes = {"time": len(self._rows), **self._sizes()}
        for variable in self._table:
            if variable.optional and variable.name not in self._group:
                continue
            if not sizes.keys() >= set(variable.dims) - _OPTIONAL_DIMS:  # Its length is free.
                continue
            wanted = tuple(sizes[dim] for dim in variable.dims if dim in sizes)
            shape = self._group[variable.name].shape
            if shape != wanted:
                raise DamagedError(f"{self.path}: {variable.name} has shape {shape}, wanted {wanted}; copy it again")

    def _require_content(self) -> None:
        wanted = to_python(self._group.attrs["content_sha256"])
        got = content_sha256(self._group, self._table)
        if got != wanted:
            raise DamagedError(
                f"{self.path}: the content of sensor {self.sensor} has SHA-256 {got[:8]}…, but the file states "
                f"{str(wanted)[:8]}…: the file is damaged; copy it again"
            )


def _place(path: Source) -> Path:
    """Return the path of a file, or the last part of the name of a file object; those of fsspec have a ``path``."""
    if isinstance(path, str | PathLike):
        return Path(path)
    names = (getattr(path, each, None) for each in ("path", "name"))  # a pipe has a number as its name
    return Path(next((Path(name).name for name in names if isinstance(name, str)), "file object"))


def _opened(path: Source, wanted: str) -> h5py.File:
    return (
        open_file(Path(path), wanted) if isinstance(path, str | PathLike) else open_binary(path, _place(path), wanted)
    )


def _kind(file: h5py.File, path: Path, wanted: str) -> str:
    with reading(file, path):
        require_attributes(file)
    kind = to_python(file.attrs.get("ertis_format", ""))
    version = to_python(file.attrs.get("ertis_format_version", 0))
    if isinstance(kind, str) and kind == "occupancy_map":
        raise DataError(f"{path} is an occupancy map; choose {wanted}")
    if not isinstance(kind, str) or kind not in _KIND_NAMES or not isinstance(version, int):
        raise DataError(f"{path} {_problem(file, path, wanted)}")
    if version > FORMAT_VERSION:
        raise FormatVersionError(
            f"{path} has format version {version}, but this package reads up to {FORMAT_VERSION}; update ertis-numba"
        )
    if version < OLDEST_VERSION:
        raise FormatVersionError(
            f"{path} has format version {version}, but this package reads {OLDEST_VERSION} to {FORMAT_VERSION}; make "
            "the file again from its source"
        )
    return str(kind)


def _problem(file: h5py.File, path: Path, wanted: str) -> str:
    """Return the kind of an HDF5 file of another program, and the remedy."""
    kind = kind_of(path)
    if kind is not None and not kind.is_hdf5:  # MATLAB puts its name before the HDF5.
        return problem_of(path, wanted)
    remedy = f"choose {wanted}"
    if "time_data" in file and "recording" in wanted:
        name = quoted(path)
        remedy = f"import its signals with 'ertis import signals {name} --settings FILE.toml --output FILE.h5'"
    return f"is HDF5, but not of this package; {remedy}"


def _attributes(file: h5py.File) -> dict[str, object]:
    """Return the attributes of a file, except for those that other programs added in types without an equivalent."""
    found = {}
    for name in file.attrs:
        with suppress(TypeError, ValueError):
            found[name] = to_python(file.attrs[name])
    return found
