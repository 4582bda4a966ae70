"""Recordings that commands must refuse.

They contain links, foreign data, missing rows, unexpected types and excessive settings.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.settings import Processing, Recording, Settings
from ertis_numba.storage import write_recording
from tests.faults.network.hostile_hellos import hostile_texts

__all__ = ["HostileFile", "hostile_files", "write_good"]

_SENSOR: Final = "front"
_GROUP: Final = f"sensors/{_SENSOR}"
_SETTINGS: Final = Settings(
    recording=Recording(n_samples=32_768), processing=Processing(directions="2d:9", range_m=(0.3, 1.0))
)
_READ: Final = (
    "time", "time_uncertainty", "sequence", "sync_count", "session_id", "crc32", "temperature", "humidity", "pressure",
    "pdm", "settings", "microphone", "microphone_position", "microphone_enabled", "calibration_gain",
    "calibration_delay", "call", "gap_first", "gap_last", "gap_reason", "gap_session_id",
)  # fmt: skip
_ROWS: Final = 10**8


@dataclass(frozen=True, slots=True)
class HostileFile:
    """Recording with a defect.

    Attributes
    ----------
    name : str
    spoil : callable
        Adds the defect. Called with the open file, which is a copy of a valid one, and its path.
    harmless_to : tuple of str
        Commands that may accept the file, because they do not read the defect.
    """

    name: str
    spoil: Callable[[h5py.File, Path], None]
    harmless_to: tuple[str, ...] = ()

    def make(self, good: Path, path: Path) -> None:
        """Write the file."""
        shutil.copy(good, path)
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            self.spoil(file, path)


def write_good(path: Path) -> Path:
    """Write a valid recording of three measurements."""
    rng = np.random.default_rng(1)
    words = rng.integers(0, 2**32, (3, 32_768), dtype=np.uint32)
    stamps = [
        Stamp(sensor=_SENSOR, sequence=n, sync_count=n, timestamp_ns=n, timestamp_uncertainty_ns=1) for n in (0, 1, 2)
    ]
    return write_recording(path, [Measurement(row, _SETTINGS, stamp) for row, stamp in zip(words, stamps, strict=True)])


def hostile_files() -> Iterator[HostileFile]:
    """Yield all hostile files, grouped by kind."""
    for name in _READ:
        yield from _links(name)
        yield from _elsewhere(name)
    for name in ("", "sensors", _GROUP):
        yield from _groups(name)
    for name in _READ:
        yield from _types(name)
    yield from _sizes()
    yield from _attributes()
    yield from _names()
    for name, text in hostile_texts():
        if text.strip(b"\0"):  # HDF5 pads strings with zeros.
            yield HostileFile(f"settings: {name}", _settings(text))


def _settings(text: bytes) -> Callable[[h5py.File, Path], None]:
    def spoil(file: h5py.File, _: Path) -> None:
        _replace(file, "settings", np.bytes_(text))

    return spoil


def _replace(file: h5py.File, name: str, data: Any, **options: Any) -> h5py.Dataset:
    del file[f"{_GROUP}/{name}"]
    return file.create_dataset(f"{_GROUP}/{name}", data=data, **options)


def _move(file: h5py.File, name: str, put: Callable[[str], Any]) -> None:
    """Rename a variable, and put another object in its place."""
    file.move(f"{_GROUP}/{name}", "moved")
    file[f"{_GROUP}/{name}"] = put("/moved")


def _links(name: str) -> Iterator[HostileFile]:
    def outside(file: h5py.File, path: Path) -> None:
        shutil.copy(path.with_name("good.h5"), path.with_name("other.h5"))
        del file[f"{_GROUP}/{name}"]
        file[f"{_GROUP}/{name}"] = h5py.ExternalLink("other.h5", f"/{_GROUP}/{name}")

    def twice(file: h5py.File, _: Path) -> None:
        file["again"] = file[f"{_GROUP}/{name}"]

    def to_itself(file: h5py.File, _: Path) -> None:
        del file[f"{_GROUP}/{name}"]
        file[f"{_GROUP}/{name}"] = h5py.SoftLink(f"/{_GROUP}/{name}")

    yield HostileFile(f"link: {name} in another file", outside)
    yield HostileFile(f"link: {name} out of place", lambda file, _: _move(file, name, h5py.SoftLink))
    yield HostileFile(f"link: {name} to itself", to_itself)
    yield HostileFile(f"link: {name} twice", twice)


def _elsewhere(name: str) -> Iterator[HostileFile]:
    def virtual(file: h5py.File, path: Path) -> None:
        shutil.copy(path.with_name("good.h5"), path.with_name("other.h5"))
        shape, dtype = file[f"{_GROUP}/{name}"].shape, file[f"{_GROUP}/{name}"].dtype
        layout = h5py.VirtualLayout(shape, dtype)
        layout[...] = h5py.VirtualSource("other.h5", f"/{_GROUP}/{name}", shape=shape, dtype=dtype)
        del file[f"{_GROUP}/{name}"]
        file.create_virtual_dataset(f"{_GROUP}/{name}", layout)

    def external(file: h5py.File, path: Path) -> None:
        values = file[f"{_GROUP}/{name}"][()]
        raw = path.with_name("raw.bin")
        raw.write_bytes(np.asarray(values).tobytes() or b"\0")
        n_bytes = max(1, np.asarray(values).nbytes)
        del file[f"{_GROUP}/{name}"]
        shape, dtype = np.shape(values), np.asarray(values).dtype
        file.create_dataset(f"{_GROUP}/{name}", shape, dtype, external=[(str(raw), 0, n_bytes)])

    def squeezed(file: h5py.File, _: Path) -> None:
        values = file[f"{_GROUP}/{name}"][()]
        _replace(file, name, values, chunks=np.shape(values), compression="gzip", shuffle=True)

    if name not in ("settings", "gap_first", "gap_last", "gap_reason", "gap_session_id"):
        yield HostileFile(f"elsewhere: {name} is virtual", virtual)
        yield HostileFile(f"compressed: {name}", squeezed)
    if not name.startswith("gap_"):
        yield HostileFile(f"elsewhere: {name} in a raw file", external)


def _groups(name: str) -> Iterator[HostileFile]:
    def outside(file: h5py.File, path: Path) -> None:
        shutil.copy(path.with_name("good.h5"), path.with_name("other.h5"))
        del file[name]
        file[name] = h5py.ExternalLink("other.h5", f"/{name}")

    def inside(file: h5py.File, _: Path) -> None:
        file.move(name, "moved")
        file[name] = h5py.SoftLink("/moved")

    def round_about(file: h5py.File, _: Path) -> None:
        file[f"{name or '/'}/loop"] = file[name or "/"]

    def a_dataset(file: h5py.File, _: Path) -> None:
        del file[name]
        file[name] = 1

    if name:
        yield HostileFile(f"link: /{name} in another file", outside)
        yield HostileFile(f"link: /{name} out of place", inside)
        yield HostileFile(f"link: /{name} in itself", round_about)
        yield HostileFile(f"type: /{name} is a dataset", a_dataset)


def _types(name: str) -> Iterator[HostileFile]:
    def of(dtype: Any) -> Callable[[h5py.File, Path], None]:
        def spoil(file: h5py.File, _: Path) -> None:
            shape = file[f"{_GROUP}/{name}"].shape
            del file[f"{_GROUP}/{name}"]
            file.create_dataset(f"{_GROUP}/{name}", shape, dtype)

        return spoil

    def a_group(file: h5py.File, _: Path) -> None:
        del file[f"{_GROUP}/{name}"]
        file.create_group(f"{_GROUP}/{name}")

    def a_type(file: h5py.File, _: Path) -> None:
        del file[f"{_GROUP}/{name}"]
        file[f"{_GROUP}/{name}"] = np.dtype("<f8")

    def empty(file: h5py.File, _: Path) -> None:
        dtype = file[f"{_GROUP}/{name}"].dtype
        del file[f"{_GROUP}/{name}"]
        file[f"{_GROUP}/{name}"] = h5py.Empty(dtype)

    yield HostileFile(f"type: {name} of text that grows", of(h5py.string_dtype()))
    yield HostileFile(f"type: {name} of lists that grow", of(h5py.vlen_dtype(np.dtype("i4"))))
    yield HostileFile(f"type: {name} of references", of(h5py.ref_dtype))
    yield HostileFile(f"type: {name} of records", of(np.dtype([("a", "f8"), ("b", "S8")])))
    yield HostileFile(f"type: {name} of 100 MB each", of(np.dtype(("f8", (12_500_000,)))))
    yield HostileFile(f"type: {name} of complex numbers", of(np.dtype("c16")))
    yield HostileFile(f"type: {name} is a group", a_group)
    yield HostileFile(f"type: {name} is a type", a_type)
    yield HostileFile(f"type: {name} is empty", empty)


def _unwritten(*names: str) -> Callable[[h5py.File, Path], None]:
    """Return a function that creates rows without chunks."""

    def spoil(file: h5py.File, _: Path) -> None:
        for name in names:
            file[f"{_GROUP}/{name}"].resize(_ROWS, axis=0)

    return spoil


def _of_shape(name: str, shape: tuple[int, ...]) -> Callable[[h5py.File, Path], None]:
    """Return a function that creates a variable of a shape without writing it."""

    def spoil(file: h5py.File, _: Path) -> None:
        dtype = file[f"{_GROUP}/{name}"].dtype
        del file[f"{_GROUP}/{name}"]
        file.create_dataset(f"{_GROUP}/{name}", shape, dtype)

    return spoil


def _bomb(file: h5py.File, _: Path) -> None:
    del file[f"{_GROUP}/pdm"]
    made = file.create_dataset(f"{_GROUP}/pdm", (3, 2**28), "<u4", chunks=(1, 2**22), compression="gzip")
    made[0, : 2**22] = 0


def _sizes() -> Iterator[HostileFile]:
    yield HostileFile(f"rows: {_ROWS:,} that are not there", _unwritten(*_READ[:10]))
    yield HostileFile(f"rows: {_ROWS:,} gaps that are not there", _unwritten(*_READ[-4:]))
    for name in ("time", "crc32", "temperature", "pdm", "gap_first", "gap_reason"):
        yield HostileFile(f"rows: {_ROWS:,} of {name}", _unwritten(name))
    for name in ("call", "microphone", "microphone_position", "calibration_gain"):
        yield HostileFile(
            f"shape: {name} of a billion", _of_shape(name, (10**9, 3)[: 1 + (name == "microphone_position")])
        )
        yield HostileFile(f"shape: {name} of four axes", _of_shape(name, (10, 10, 10, 10)))
    yield HostileFile("shape: pdm of 1 TB", _of_shape("pdm", (10**6, 2**18)))
    yield HostileFile("shape: pdm of no rows", _of_shape("pdm", (0, 32_768)))
    yield HostileFile("shape: pdm of rows without samples", _of_shape("pdm", (3, 0)))
    yield HostileFile("shape: settings of a million", _of_shape("settings", (10**6,)))
    yield HostileFile("compressed: 3 GB of zeros", _bomb)
    for n_bytes in (262_145, 10**6, 2**28):
        yield HostileFile(f"settings: text of {n_bytes:,} bytes", _long_settings(n_bytes))


def _long_settings(n_bytes: int) -> Callable[[h5py.File, Path], None]:
    def spoil(file: h5py.File, _: Path) -> None:
        del file[f"{_GROUP}/settings"]
        file.create_dataset(f"{_GROUP}/settings", (), h5py.string_dtype("utf-8", n_bytes))

    return spoil


def _attributes() -> Iterator[HostileFile]:
    def long(owner: str) -> Callable[[h5py.File, Path], None]:
        def spoil(file: h5py.File, _: Path) -> None:
            file[owner].attrs.create("firmware", np.zeros(3_000_000))

        return spoil

    def many(owner: str) -> Callable[[h5py.File, Path], None]:
        def spoil(file: h5py.File, _: Path) -> None:
            for number in range(5000):
                file[owner].attrs[f"a{number}"] = number

        return spoil

    def odd(name: str, value: Any) -> Callable[[h5py.File, Path], None]:
        def spoil(file: h5py.File, _: Path) -> None:
            owner = file if name in file.attrs else file[_GROUP]
            owner.attrs[name] = value

        return spoil

    for owner in ("/", _GROUP):
        yield HostileFile(f"attribute: 24 MB of {owner}", long(owner))
        yield HostileFile(f"attribute: 5,000 of {owner}", many(owner))
    yield HostileFile("attribute: version of 10^9", odd("ertis_format_version", 10**9))
    yield HostileFile("attribute: kind that is unknown", odd("ertis_format", "film"))
    yield HostileFile("attribute: kind that is a list", odd("ertis_format", [1.0, 2.0]))
    yield HostileFile("attribute: SHA-256 of another content", odd("content_sha256", "0" * 64))
    yield HostileFile("attribute: SHA-256 that is a number", odd("content_sha256", 7))


def _names() -> Iterator[HostileFile]:
    def crowd(file: h5py.File, _: Path) -> None:
        for number in range(5000):
            file.create_group(f"sensors/s{number}")

    def renamed(name: str) -> Callable[[h5py.File, Path], None]:
        return lambda file, _: file.move(_GROUP, f"sensors/{name}")

    def shared(file: h5py.File, _: Path) -> None:
        """Store the same rows under many names. Each name takes the full time to read."""
        for number in range(200):
            made = file.create_group(f"sensors/s{number}")
            for name, dataset in file[_GROUP].items():
                made[name] = dataset
            for name, value in file[_GROUP].attrs.items():
                made.attrs[name] = value

    yield HostileFile("names: 5,000 sensors", crowd)
    yield HostileFile("names: the same rows under 201 names", shared)
    for name in ("..", "a b", "\x1b[31mred", "-o", "x" * 20_000, "\u202egnp", "na\nme", "~", "*", "$(id)"):
        yield HostileFile(f"names: sensor {name[:12]!r}", renamed(name))
