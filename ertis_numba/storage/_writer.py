"""Base class of the writers of files with one row per measurement: part file, rows, and verification."""

import os
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Generic, Self, TypeVar

import h5py
from numpy.typing import NDArray

from ertis_numba.base.atomic_files import (
    atomic_write,
    check_target,
    reason,
    remedy,
    require_free_space,
    require_writable,
)
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import AcousticMap, Energyscape, Measurement
from ertis_numba.storage._rows import RowReader, RowWriter
from ertis_numba.storage.schema import (
    CONVENTIONS,
    VERSION_WITHOUT_POSES,
    Variable,
    content_sha256,
    content_uuid,
    date_created,
    sensor_path,
    software_versions,
)
from ertis_numba.storage.truth import GroundTruth, GroundTruthLog, write_truth
from ertis_numba.storage.variables import set_attributes

__all__ = ["FileWriter"]

Item = TypeVar("Item", Measurement, Energyscape, AcousticMap)

_OTHER_SUFFIXES = (
    *(".bin", ".raw", ".wav", ".flac"),
    *(".csv", ".json", ".mat", ".npy", ".npz", ".toml", ".tum", ".txt"),
    *(".html", ".jpg", ".mcap", ".pcd", ".pdf", ".ply", ".png", ".svg"),
)


class FileWriter(ABC, Generic[Item]):
    """Writer of rows; the file appears when the ``with`` block ends without an error.

    Rows of several sensors may come in any order; each sensor has its own group.
    """

    _kind: ClassVar[str]
    _data: str
    _table: tuple[Variable, ...]
    _numbered: ClassVar[bool]
    _part_token: ClassVar[str | None] = None

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool,
        attributes: Mapping[str, str],
        truth: Mapping[str, GroundTruth | GroundTruthLog] | None,
    ) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        self._attributes = dict(attributes)
        self._truth = dict(truth or {})
        self._part: Path
        self._format_version = VERSION_WITHOUT_POSES
        self._file: h5py.File | None = None
        self._rows: dict[str, RowWriter] = {}
        if self.path.suffix.lower() in _OTHER_SUFFIXES:
            raise ArgumentError(
                f"output {self.path} ends in {self.path.suffix}, but the file is HDF5; choose a name that ends in .h5"
            )
        check_target(self.path, overwrite=overwrite)
        try:  # before warnings on what is to be written
            require_writable(self.path.parent)
        except OSError as error:
            raise DataError(f"{self.path} cannot be written ({reason(error)}); {remedy(error)}") from error

    @abstractmethod
    def _begin(self, group: h5py.Group, first: Item) -> None:
        """Create the variables of a sensor for items like ``first``; do not write ``first`` yet."""

    @abstractmethod
    def _row(self, item: Item) -> tuple[NDArray[Any], dict[str, float]]:
        """Return the array and the columns of an item; refuse an item that does not match the others."""

    def _data_of(self, group: h5py.Group) -> str:  # noqa: ARG002  for subclasses
        """Return the variable with one array per measurement."""
        return self._data

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        """Write the parts that are known only at the end."""

    def _sensor_truth(self, sensor: str, group: h5py.Group) -> GroundTruth | GroundTruthLog | None:  # noqa: ARG002  for subclasses
        """Return the ground truth of a sensor, if known."""
        return self._truth.get(sensor)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._part = stack.enter_context(atomic_write(self.path, overwrite=self._overwrite, token=self._part_token))
            self._file = stack.enter_context(self._open_part())
            self._stack = stack.pop_all()
        return self

    def write(self, item: Item) -> None:
        """Append one measurement.

        Raises
        ------
        ArgumentError
            The measurement does not match earlier ones or its settings.
        DataError
            The disk is full or not writable.
        """
        if self._file is None:
            raise ArgumentError(f"{self.path} is not open for writing; use the writer in a with statement")
        with self._errors_with_path():
            sensor = item.stamp.sensor
            if sensor not in self._rows:
                group = self._file.create_group(sensor_path(sensor), track_order=True)
                self._begin(group, item)
                self._rows[sensor] = RowWriter(group, self._data_of(group), numbered=self._numbered)
            row, columns = self._row(item)
            self._rows[sensor].append(row, item.stamp, **columns)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        self._file = None

    @contextmanager
    def _open_part(self) -> Iterator[h5py.File]:
        """Yield the part file; complete, close and compare it when the block ends without an error."""
        require_free_space(self.path.parent, 0)
        with self._errors_with_path():
            # The newer layout has a checksum in every table, which reveals damage.
            file = h5py.File(self._part, "w", track_order=True, libver=("v110", "v110"))
        try:
            yield file
            with self._errors_with_path():
                self._finish(file)
                file.close()
                self._verify_part()
        except BaseException:
            # Closing writes buffered data. If that fails, HDF5 crashes the process (h5py issue 914). Emptying the file
            # first frees the necessary space on a full disk.
            with suppress(OSError, RuntimeError):  # The first error is the one to report.
                os.truncate(self._part, 0)
                file.close()
            raise

    def _finish(self, file: h5py.File) -> None:
        if not self._rows:
            raise ArgumentError(f"{self.path} would contain no measurement; write at least one")
        self._require_sensors("truth", self._truth)
        contents = {sensor: self._finish_sensor(file, sensor) for sensor in self._rows}
        set_attributes(
            file,
            {
                "Conventions": CONVENTIONS,
                "ertis_format": self._kind,
                "ertis_format_version": self._format_version,
                "date_created": date_created(),
                "uuid": content_uuid(contents),
                **self._attributes,
                **{f"{name.replace('-', '_')}_version": version for name, version in software_versions().items()},
            },
        )

    def _finish_sensor(self, file: h5py.File, sensor: str) -> str:
        """Write the parts that are known only at the end, and return the SHA-256 of the sensor's content."""
        rows, group = self._rows[sensor], file[sensor_path(sensor)]
        rows.flush()
        self._complete(group, rows)
        truth = self._sensor_truth(sensor, group)
        if truth is not None:
            write_truth(group, truth, len(rows))
        content = content_sha256(group, self._table)
        set_attributes(group, {"content_sha256": content})
        return content

    def _require_sensors(self, name: str, given: Iterable[str]) -> None:
        """Refuse data of a sensor without measurements, because it would be lost."""
        for sensor in given:
            if sensor not in self._rows:
                raise ArgumentError(
                    f"{name} is given for sensor {sensor!r}, which has no measurement; {self.path} would contain "
                    f"{', '.join(self._rows)}"
                )

    def _verify_part(self) -> None:
        """Read all rows back from the closed file, and compare them with the given ones."""
        with h5py.File(self._part, "r") as file:
            for sensor, written in self._rows.items():
                group = file[sensor_path(sensor)]
                rows = RowReader(group, self._data_of(group))
                check = 0
                for index in range(len(rows)):
                    check = zlib.crc32(rows.row(index).data, check)
                if (len(rows), check) != (len(written), written.check):
                    raise DataError(f"{self.path} reads back with other content than written; check the disk")

    @contextmanager
    def _errors_with_path(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:  # h5py raises both when the disk fails.
            raise DataError(f"{self.path} cannot be written ({reason(error)}); {remedy(error)}") from error
