"""What a simulated sensor should show."""

from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Reflector
from ertis_numba.storage.schema import TRUTH, describe, lay_out, text_type

__all__ = ["Truth", "read_truth", "write_truth"]

_FIELDS = {
    "azimuth": "azimuth_deg",
    "elevation": "elevation_deg",
    "range": "range_m",
    "level": "level_db",
    "velocity": "velocity_m_s",
}
_TEXTS = ("name", "emitter")
_ANGLES = ("azimuth", "elevation")  # radians in the file, as its other angles
_MOST_SEED = 2**63 - 1  # what an attribute holds


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What a simulated sensor should show.

    Attributes
    ----------
    scene : str
        The scene as TOML.
    seed : int
    reflectors : tuple of tuple of Reflector
        Those of each measurement, the strongest first.
    """

    scene: str
    seed: int
    reflectors: tuple[tuple[Reflector, ...], ...]

    def __post_init__(self) -> None:
        checks.whole("seed", self.seed, 0, _MOST_SEED)
        for name, values in _columns(self.reflectors).items():
            checks.finite_array(f"{_FIELDS[name]} of the true reflectors", values)


def write_truth(group: h5py.Group, truth: Truth, n_measurements: int) -> None:
    """Write what a sensor should show into its group.

    Raises
    ------
    ArgumentError
        The truth is about another number of measurements.
    """
    reflectors = truth.reflectors
    if len(reflectors) != n_measurements:
        raise ArgumentError(
            f"the truth of sensor {group.name.rpartition('/')[2]} is about {len(reflectors)} measurements, "
            f"the file holds {n_measurements}; give the reflectors of each"
        )
    flat = [reflector for row in reflectors for reflector in row]
    texts = {field: [getattr(reflector, field).encode() for reflector in flat] for field in _TEXTS}
    if not any(texts["emitter"]):  # files of a single sensor are the same as ever
        del texts["emitter"]
    kinds: dict[str, Any] = {field: text_type(max(map(len, column), default=0)) for field, column in texts.items()}
    sizes = {"measurement": n_measurements, "target": max(map(len, reflectors)), "axis": 3}
    made = group.create_group("truth", track_order=True)
    table = [variable for variable in TRUTH if not variable.optional or variable.name in texts]
    lay_out(made, table, sizes=sizes, dtypes=kinds, texts={"scene": truth.scene})
    describe(made, {"seed": truth.seed})
    given = _given(reflectors, sizes["target"])
    for field, column in texts.items():
        _fill(made[field], given, np.array(column, dtype=kinds[field]), b"")
    for name, values in _columns(reflectors).items():
        _fill(made[name], given, values, np.nan)


def read_truth(group: h5py.Group) -> Truth | None:
    """Return what a sensor should show, where it is known, from its group."""
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
    return Truth(scene=group["scene"][()].decode(), seed=int(group.attrs["seed"]), reflectors=tuple(rows))


def _columns(reflectors: tuple[tuple[Reflector, ...], ...]) -> dict[str, NDArray[np.float64]]:
    """Return the numbers of all reflectors, one measurement after the other: (reflector,) or (reflector, axis)."""
    flat = [reflector for row in reflectors for reflector in row]
    columns = {
        name: np.array([getattr(reflector, field) for reflector in flat], dtype=np.float64)
        for name, field in _FIELDS.items()
    }
    columns["velocity"] = columns["velocity"].reshape(-1, 3)
    return columns | {name: np.radians(columns[name]) for name in _ANGLES}


def _given(reflectors: tuple[tuple[Reflector, ...], ...], n_targets: int) -> NDArray[np.bool_]:
    """Return where a measurement has a reflector: (measurement, target)."""
    counts = np.array([len(row) for row in reflectors])
    return np.asarray(np.arange(n_targets) < counts[:, None])


def _fill(dataset: h5py.Dataset, given: NDArray[np.bool_], values: NDArray[Any], missing: object) -> None:
    whole = np.full(dataset.shape, missing, dtype=dataset.dtype)
    whole[given] = values
    if whole.size:  # HDF5 has no room, and needs none, for nothing
        dataset[...] = whole
