"""Ground truth of simulated sensors."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.atomic_files import remedy
from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.frames import Reflector
from ertis_numba.storage.schema import TRUTH, create_variables, set_attributes, text_type, to_python

__all__ = ["GroundTruth", "GroundTruthLog", "read_truth", "write_truth"]

_FIELDS = {
    "azimuth": "azimuth_deg",
    "elevation": "elevation_deg",
    "range": "range_m",
    "level": "level_db",
    "velocity": "velocity_m_s",
}
_TEXTS = ("name", "emitter")
_ANGLES = ("azimuth", "elevation")  # The file stores radians, as for its other angles.
_MAX_SEED = 2**63 - 1  # Limit of an attribute.
_BLOCK_ROWS = 512  # Limit on the measurements whose reflectors are in memory.
_RECORD = np.dtype(
    [("row", "<i8"), ("target", "<i4"), *((name, "<i4") for name in _TEXTS)]
    + [(name, "<f8", 3 if name == "velocity" else ()) for name in _FIELDS]
)


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
    """

    scene: str
    seed: int
    reflectors: tuple[tuple[Reflector, ...], ...]
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        checks.integer("seed", self.seed, 0, _MAX_SEED)
        for name, values in _columns(self.reflectors).items():
            checks.finite_array(f"{_FIELDS[name]} of the true reflectors", values)


class GroundTruthLog:
    """Ground truth that grows with each measurement, in a temporary file; use it in a ``with`` statement.

    Parameters
    ----------
    scene : str
        Scene as TOML.
    seed : int
        Seed of the simulation.
    left_out : tuple of str
        Effects that were not simulated although they change the image slightly; none by default.
    folder : Path, optional
        Folder of the temporary file, by default that of the system. The file has no name, and is removed with the
        process.
    """

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

    def append(self, reflectors: Sequence[Reflector]) -> None:
        """Add the reflectors of the next measurement, the strongest first."""
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
                self._file.flush()
            self._block_sizes.append(records.nbytes)
            self._waiting.clear()

    @contextmanager
    def _errors_with_folder(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DataError(
                f"{self._folder}: a temporary file cannot be written ({error.strerror}); {remedy(error)}"
            ) from error

    def blocks(self) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the rows of each block of measurements, and the records of their reflectors."""
        self._flush()
        self._file.seek(0)
        for number, n_bytes in enumerate(self._block_sizes):
            first = number * _BLOCK_ROWS
            records = np.frombuffer(self._file.read(n_bytes), _RECORD)
            yield slice(first, min(first + _BLOCK_ROWS, self._rows)), records


def write_truth(group: h5py.Group, truth: GroundTruth | GroundTruthLog, n_measurements: int) -> None:
    """Write the ground truth of a sensor into its group.

    Raises
    ------
    ArgumentError
        The truth has another number of measurements than the file.
    """
    if isinstance(truth, GroundTruth):
        with GroundTruthLog(truth.scene, truth.seed, left_out=truth.left_out) as log:
            for reflectors in truth.reflectors:
                log.append(reflectors)
            write_truth(group, log, n_measurements)
        return
    if len(truth) != n_measurements:
        raise ArgumentError(
            f"the truth of sensor {group.name.rpartition('/')[2]} has {len(truth)} measurements, but the file "
            f"has {n_measurements}; give the reflectors of each"
        )
    texts = {field: truth.texts(field) for field in _TEXTS}
    if not any(texts["emitter"]):  # Files of a single sensor stay as in earlier versions.
        del texts["emitter"]
    kinds: dict[str, Any] = {field: text_type(max(map(len, column), default=0)) for field, column in texts.items()}
    sizes = {"measurement": n_measurements, "target": truth.n_targets, "axis": 3}
    made = group.create_group("truth", track_order=True)
    table = [variable for variable in TRUTH if not variable.optional or variable.name in texts]
    create_variables(made, table, sizes=sizes, dtypes=kinds, texts={"scene": truth.scene})
    set_attributes(made, {"seed": truth.seed, "effects_left_out": " ".join(truth.left_out)})
    if not truth.n_targets:  # There is no data to write.
        return
    columns = {field: np.array(column, dtype=kinds[field]) for field, column in texts.items()}
    for rows, records in truth.blocks():
        place = records["row"] - rows.start, records["target"]
        for name in (*columns, *_FIELDS):
            dataset = made[name]
            missing: object = b"" if name in columns else np.nan
            whole = np.full((rows.stop - rows.start, *dataset.shape[1:]), missing, dtype=dataset.dtype)
            whole[place] = columns[name][records[name]] if name in columns else records[name]
            dataset[rows] = whole


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
    )


def _columns(reflectors: Sequence[Sequence[Reflector]]) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of all reflectors, one measurement after the other: (reflector,) or (reflector, axis)."""
    flat = [reflector for row in reflectors for reflector in row]
    columns = {
        name: np.array([getattr(reflector, field) for reflector in flat], dtype=np.float64)
        for name, field in _FIELDS.items()
    }
    columns["velocity"] = columns["velocity"].reshape(-1, 3)
    return columns | {name: np.radians(columns[name]) for name in _ANGLES}
