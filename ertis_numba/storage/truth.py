"""Ground truth of simulated sensors."""

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import remedy
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Reflector, TrueSource
from ertis_numba.storage.schema import TRUTH
from ertis_numba.storage.variables import create_variables, set_attributes, text_type, to_python

__all__ = ["Frame", "GroundTruth", "GroundTruthLog", "read_truth", "write_truth"]

_FIELDS = {
    "azimuth": "azimuth_deg",
    "elevation": "elevation_deg",
    "range": "range_m",
    "level": "level_db",
    "velocity": "velocity_m_s",
}
_TEXTS = ("name", "emitter")
_ANGLES = ("azimuth", "elevation")  # The file stores radians, as for its other angles.
_MAX_LENGTH_ERROR = 1e-3  # Of a unit quaternion.
_MAX_SEED = 2**63 - 1  # Limit of an attribute.
_BLOCK_ROWS = 512  # Limit on the measurements whose reflectors are in memory.
_RECORD = np.dtype(
    [("row", "<i8"), ("target", "<i4"), *((name, "<i4") for name in _TEXTS)]
    + [(name, "<f8", 3 if name == "velocity" else ()) for name in _FIELDS]
)
_PLACES = ("position", "azimuth", "elevation", "range", "level")
_SOURCE_TEXTS = ("name", "kind")
_SOURCE_RECORD = np.dtype([(name, "<f8", 3 if name == "position" else ()) for name in _PLACES])
_OF_SOURCES = "source_"  # First part of the names of variables.
_SOURCE_VARIABLES = {f"{_OF_SOURCES}{name}" for name in (*_SOURCE_TEXTS, "band", *_PLACES)}
_FRAME_VARIABLES = ("frame_position", "frame_rotation")

Frame = tuple[tuple[float, ...], tuple[float, ...]]
"""Position x, y, z in metres, and unit quaternion x, y, z, w."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTruth:
    """Ground truth of a simulated sensor.

    Attributes
    ----------
    scene : str
        Scene as TOML.
    seed : int
        Seed of the simulation.
    reflectors : tuple of tuple of Reflector
        Reflectors of each measurement, the strongest first.
    left_out : tuple of str
        Effects that were not simulated although they change the image slightly; none by default.
    sources : tuple of tuple of TrueSource
        Sources of sound during each measurement, in the order of the scene; empty, the default, if there are none.
    frames : tuple of (position_m, rotation_xyzw)
        Pose in the scene of the frame of the reflectors of each measurement, for fused images and maps. Empty, the
        default, if it is the frame of the sensor.
    """

    scene: str
    seed: int
    reflectors: tuple[tuple[Reflector, ...], ...]
    left_out: tuple[str, ...] = ()
    sources: tuple[tuple[TrueSource, ...], ...] = ()
    frames: tuple[Frame, ...] = ()

    def __post_init__(self) -> None:
        checks.integer("seed", self.seed, 0, _MAX_SEED)
        for name, values in _columns(self.reflectors).items():
            checks.finite_array(f"{_FIELDS[name]} of the true reflectors", values)
        if self.sources and len(self.sources) != len(self.reflectors):
            raise ArgumentError(
                f"the truth has sources of {len(self.sources)} measurements, but reflectors of "
                f"{len(self.reflectors)}; pass both for each measurement"
            )
        if self.frames and len(self.frames) != len(self.reflectors):
            raise ArgumentError(
                f"the truth has frames of {len(self.frames)} measurements, but reflectors of {len(self.reflectors)}; "
                "pass both of each"
            )
        for number, (_, rotation_xyzw) in enumerate(self.frames):
            if abs(math.hypot(*rotation_xyzw) - 1.0) > _MAX_LENGTH_ERROR:
                raise ArgumentError(f"the rotation of frame {number} is {rotation_xyzw}; pass a unit quaternion")


class GroundTruthLog:
    """Ground truth that grows with each measurement, in a nameless temporary file; use it in a ``with`` statement."""

    def __init__(self, scene: str, seed: int, *, left_out: tuple[str, ...] = (), folder: Path | None = None) -> None:
        self.scene = scene
        self.seed = checks.integer("seed", seed, 0, _MAX_SEED)
        self.left_out = left_out
        self._texts: dict[str, dict[str, int]] = {field: {} for field in _TEXTS}
        self._rows = 0
        self._max_targets = 0
        self._max_own = 0
        self._last: tuple[Sequence[Reflector], NDArray[Any]] = ((), np.zeros(0, _RECORD))
        self._waiting: list[NDArray[Any]] = []
        self._waiting_sources: list[NDArray[Any]] = []
        self._last_sources: tuple[Sequence[TrueSource], NDArray[Any]] = ((), np.zeros(0, _SOURCE_RECORD))
        self.sources: tuple[TrueSource, ...] = ()
        self._block_sizes: list[int] = []
        self._folder = folder or Path(tempfile.gettempdir())
        with self._errors_with_folder():
            self._file = tempfile.TemporaryFile(dir=folder, prefix="ertis-truth-")  # noqa: SIM115  closed on exit

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # An error of a full disk was reported before.
            self._file.close()

    def __len__(self) -> int:
        return self._rows

    @property
    def n_targets(self) -> int:
        """The largest number of reflectors of a measurement."""
        return self._max_targets

    @property
    def n_own_targets(self) -> int:
        """The largest number of reflectors of a measurement that return the sensor's own call."""
        return self._max_own

    def texts(self, field: str) -> list[bytes]:
        """Return the values of a text field of reflectors, by their number in the records."""
        return [text.encode() for text in self._texts[field]]

    def append(self, reflectors: Sequence[Reflector], sources: Sequence[TrueSource] = ()) -> None:
        """Add the next reflectors, the strongest first, and sources of sound, always the same at any positions."""
        if not self._rows:
            self.sources = tuple(sources)
        names, wanted = [each.name for each in sources], [each.name for each in self.sources]
        if names != wanted:
            raise ArgumentError(f"measurement {self._rows} has the sources {names}; pass {wanted}, as in the first")
        if sources is not self._last_sources[0]:
            self._last_sources = sources, _places(sources)
        self._waiting_sources.append(self._last_sources[1])
        if reflectors is not self._last[0]:  # A static scene repeats the same reflectors.
            self._last = reflectors, self._encoded(reflectors)
        records = self._last[1].copy()
        records["row"] = self._rows
        self._waiting.append(records)
        self._rows += 1
        self._max_targets = max(self._max_targets, len(records))
        self._max_own = max(self._max_own, sum(not each.emitter for each in reflectors))
        if self._rows % _BLOCK_ROWS == 0:
            self._flush()

    def _encoded(self, reflectors: Sequence[Reflector]) -> NDArray[Any]:
        columns = _columns((reflectors,))
        records = np.zeros(len(reflectors), _RECORD)
        records["target"] = np.arange(len(reflectors))
        for field, numbers in self._texts.items():
            records[field] = [numbers.setdefault(getattr(each, field), len(numbers)) for each in reflectors]
        for name, values in columns.items():
            checks.finite_array(f"{_FIELDS[name]} of the true reflectors", values)
            records[name] = values
        return records

    def _flush(self) -> None:
        if self._waiting:
            records = np.concatenate(self._waiting)
            with self._errors_with_folder():
                self._file.write(records.tobytes())
                self._file.write(np.concatenate(self._waiting_sources).tobytes())
                self._file.flush()
            self._block_sizes.append(records.nbytes)
            self._waiting.clear()
            self._waiting_sources.clear()

    @contextmanager
    def _errors_with_folder(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DataError(
                f"{self._folder}: a temporary file cannot be written ({error.strerror}); {remedy(error)}"
            ) from error

    def blocks(self) -> Iterator[tuple[slice, NDArray[Any], NDArray[Any]]]:
        """Yield the rows of each block of measurements, and the records of their reflectors and of their sources."""
        self._flush()
        self._file.seek(0)
        for number, n_bytes in enumerate(self._block_sizes):
            first = number * _BLOCK_ROWS
            rows = slice(first, min(first + _BLOCK_ROWS, self._rows))
            records = np.frombuffer(self._file.read(n_bytes), _RECORD)
            shape = rows.stop - rows.start, len(self.sources)
            sources = self._file.read(shape[0] * shape[1] * _SOURCE_RECORD.itemsize)
            yield rows, records, np.frombuffer(sources, _SOURCE_RECORD).reshape(shape)


def write_truth(group: h5py.Group, truth: GroundTruth | GroundTruthLog, n_measurements: int) -> None:
    """Write the ground truth of a sensor into its group."""
    if isinstance(truth, GroundTruth):
        with GroundTruthLog(truth.scene, truth.seed, left_out=truth.left_out) as log:
            for row, reflectors in enumerate(truth.reflectors):
                log.append(reflectors, truth.sources[row] if truth.sources else ())
            write_truth(group, log, n_measurements)
        _write_frames(group["truth"], truth.frames)
        return
    if len(truth) != n_measurements:
        raise ArgumentError(
            f"the truth of sensor {group.name.rpartition('/')[2]} has {len(truth)} measurements, but the file "
            f"has {n_measurements}; pass the reflectors of each"
        )
    texts = {field: truth.texts(field) for field in _TEXTS}
    if not any(texts["emitter"]):  # Files of a single sensor stay as in earlier versions.
        del texts["emitter"]
    kinds: dict[str, Any] = {field: text_type(max(map(len, column), default=0)) for field, column in texts.items()}
    kinds |= _source_kinds(truth.sources)
    sizes = {"measurement": n_measurements, "target": truth.n_targets, "axis": 3}
    if truth.sources:
        sizes |= {"source": len(truth.sources), "edge": 2}
    made = group.create_group("truth", track_order=True)
    written = texts.keys() | (_SOURCE_VARIABLES if truth.sources else set())
    table = [variable for variable in TRUTH if not variable.optional or variable.name in written]
    create_variables(made, table, sizes=sizes, dtypes=kinds, texts={"scene": truth.scene})
    set_attributes(made, {"seed": truth.seed, "effects_left_out": " ".join(truth.left_out)})
    columns = {field: np.array(column, dtype=kinds[field]) for field, column in texts.items()}
    for rows, records, sources in truth.blocks():
        _write_sources(made, truth.sources, rows, sources)
        if not truth.n_targets:  # There is no data to write.
            continue
        place = records["row"] - rows.start, records["target"]
        for name in (*columns, *_FIELDS):
            dataset = made[name]
            missing: object = b"" if name in columns else np.nan
            whole = np.full((rows.stop - rows.start, *dataset.shape[1:]), missing, dtype=dataset.dtype)
            whole[place] = columns[name][records[name]] if name in columns else records[name]
            dataset[rows] = whole


def _write_frames(group: h5py.Group, frames: Sequence[Frame]) -> None:
    """Write the pose of the frame of each measurement."""
    table = [variable for variable in TRUTH if variable.name in _FRAME_VARIABLES and frames]
    create_variables(group, table, sizes={"measurement": len(frames), "axis": 3, "quaternion": 4})
    for variable, values in zip(table, zip(*frames, strict=True), strict=True):
        group[variable.name][:] = values


def _read_frames(group: h5py.Group) -> tuple[Frame, ...]:
    """Return the pose of the frame of each measurement, if they are stored."""
    if not all(name in group for name in _FRAME_VARIABLES):
        return ()
    columns = ([tuple(row) for row in group[name][:].tolist()] for name in _FRAME_VARIABLES)
    return tuple(zip(*columns, strict=True))


def _source_kinds(sources: Sequence[TrueSource]) -> dict[str, Any]:
    """Return the types of the texts of sources."""
    longest = {field: max((len(_encoded(each, field)) for each in sources), default=0) for field in _SOURCE_TEXTS}
    return {f"{_OF_SOURCES}{field}": text_type(n_bytes) for field, n_bytes in longest.items()}


def _write_sources(group: h5py.Group, sources: Sequence[TrueSource], rows: slice, records: NDArray[Any]) -> None:
    """Write the sources of some measurements."""
    if not sources:
        return
    for field in _SOURCE_TEXTS:
        group[f"{_OF_SOURCES}{field}"][:] = [_encoded(each, field) for each in sources]
    group[f"{_OF_SOURCES}band"][:] = [each.band_hz for each in sources]
    for name in _PLACES:
        group[f"{_OF_SOURCES}{name}"][rows] = records[name]


def read_truth(group: h5py.Group) -> GroundTruth | None:
    """Return the ground truth from a sensor's group, if there is one."""
    if "truth" not in group:
        return None
    group = group["truth"]
    columns: dict[str, list[Any]] = {}
    for name, field in _FIELDS.items():
        values = group[name][:]
        columns[field] = (np.degrees(values) if name in _ANGLES else values).tolist()
    rows = []
    emitters = group["emitter"][:].tolist() if "emitter" in group else None
    for index, names in enumerate(group["name"][:].tolist()):
        n_targets = int(np.count_nonzero(~np.isnan(columns["range_m"][index])))
        rows.append(
            tuple(
                Reflector(
                    name=names[target].decode(),
                    **{field: column[index][target] for field, column in columns.items() if field != "velocity_m_s"},
                    velocity_m_s=tuple(columns["velocity_m_s"][index][target]),
                    emitter="" if emitters is None else emitters[index][target].decode(),
                )
                for target in range(n_targets)
            )
        )
    left_out = str(to_python(group.attrs.get("effects_left_out", b"")))  # Unknown for older files.
    return GroundTruth(
        scene=group["scene"][()].decode(),
        seed=int(group.attrs["seed"]),
        reflectors=tuple(rows),
        left_out=tuple(left_out.split()),
        sources=_read_sources(group) if f"{_OF_SOURCES}name" in group else (),
        frames=_read_frames(group),
    )


def _read_sources(group: h5py.Group) -> tuple[tuple[TrueSource, ...], ...]:
    """Return the sources of each measurement."""
    names, kinds = ([text.decode() for text in group[f"{_OF_SOURCES}{field}"][:]] for field in ("name", "kind"))
    bands_hz = group[f"{_OF_SOURCES}band"][:].tolist()
    places = {name: group[f"{_OF_SOURCES}{name}"][:] for name in _PLACES}
    places |= {name: np.degrees(places[name]) for name in _ANGLES}
    return tuple(
        tuple(
            TrueSource(
                name=name,
                kind=kinds[source],
                position_m=tuple(places["position"][row, source].tolist()),
                azimuth_deg=float(places["azimuth"][row, source]),
                elevation_deg=float(places["elevation"][row, source]),
                range_m=float(places["range"][row, source]),
                band_hz=tuple(bands_hz[source]),
                level_dbfs=float(places["level"][row, source]),
            )
            for source, name in enumerate(names)
        )
        for row in range(len(places["range"]))
    )


def _places(sources: Sequence[TrueSource]) -> NDArray[Any]:
    """Return the records of the sources of one measurement: (source,)."""
    records = np.zeros(len(sources), _SOURCE_RECORD)
    for name in _PLACES:
        field = _FIELDS.get(name, "position_m") if name != "level" else "level_dbfs"
        values = np.array([getattr(each, field) for each in sources], np.float64).reshape(records[name].shape)
        checks.finite_array(f"{field} of the true sources", values)
        records[name] = np.radians(values) if name in _ANGLES else values
    return records


def _encoded(source: TrueSource, field: str) -> bytes:
    return str(getattr(source, field)).encode()


def _columns(reflectors: Sequence[Sequence[Reflector]]) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of all reflectors, one measurement after the other: (reflector,) or (reflector, axis)."""
    flat = [reflector for row in reflectors for reflector in row]
    columns = {
        name: np.array([getattr(reflector, field) for reflector in flat], dtype=np.float64)
        for name, field in _FIELDS.items()
    }
    columns["velocity"] = columns["velocity"].reshape(-1, 3)
    return columns | {name: np.radians(columns[name]) for name in _ANGLES}
