"""Files that are complete or absent, and removal of new folders after an error."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape, Measurement
    from ertis_numba.network.products import Arrival

__all__ = ["PRODUCTS", "saving", "withdrawn"]

PRODUCTS = ("energyscape", "raw")
"""Products that can be saved to files."""

Write = Callable[["Arrival"], None]


@contextmanager
def withdrawn(*folders: Path | None) -> Iterator[list[Path]]:
    """Yield the folders that do not exist yet; if the block raises an error, remove those left in the list."""
    missing = [each for folder in folders if folder for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield missing
    except BaseException:
        for folder in missing:  # the deepest come first
            with suppress(OSError):
                found = list(folder.iterdir())
                if all(path.name.startswith(".ertis-") for path in found):
                    for path in found:
                        path.unlink()
                    folder.rmdir()
        raise


@contextmanager
def saving(target: Path | None, product: str, *, overwrite: bool) -> Iterator[Write]:
    """Yield a function that saves a product; the file appears when the block ends without an error."""
    from ertis_numba.base.errors import DataError

    if target is None:
        yield lambda _: None
        return
    _require_place(target)
    if product == "energyscape":
        from ertis_numba.storage import EnergyscapeWriter

        with EnergyscapeWriter(target, overwrite=overwrite) as writer:
            mounted: set[str] = set()

            def write(arrival: "Arrival") -> None:
                image = cast("Energyscape", arrival.item)  # the product that was requested
                if image.stamp.sensor not in mounted:
                    mounted.add(image.stamp.sensor)
                    if arrival.translation_m is not None and arrival.rotation_xyzw is not None:
                        writer.note_mounting(image.stamp.sensor, arrival.translation_m, arrival.rotation_xyzw)
                writer.write(image)

            yield write
            if not mounted:
                raise DataError(
                    f"{target} is not written, because no image was received; check 'ertis sensors status', or run the "
                    "command longer"
                )
        return
    yield from _recording(target, overwrite=overwrite)


def _require_place(target: Path) -> None:
    """Raise an error now, before any wait, if the folder of a file is missing or not writable."""
    from ertis_numba.base.errors import ArgumentError

    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise ArgumentError(
            f"--save {target}: folder {target.parent} cannot be written ({error.strerror}); create it or choose another"
        ) from error


def _recording(target: Path, *, overwrite: bool) -> Iterator[Write]:
    """Yield a function that appends measurements to a journal; the journal is then sealed into a recording."""
    from ertis_numba.base.atomic_files import check_target
    from ertis_numba.base.errors import DataError
    from ertis_numba.journal import SUFFIX, Journal, JournalEntry, seal_in_subprocess

    check_target(target, overwrite=overwrite)
    path = target.with_name(f"{target.name}{SUFFIX}")
    known: set[str] = set()
    with Journal.create(path, target=target.name, source="received from a central node") as journal:
        if journal.remark:
            options.warn(journal.remark)

        def write(arrival: "Arrival") -> None:
            measurement = cast("Measurement", arrival.item)
            sensor = measurement.stamp.sensor
            if sensor not in known:
                journal.add_sensor(
                    sensor,
                    measurement.settings,
                    translation_m=arrival.translation_m,
                    rotation_xyzw=arrival.rotation_xyzw,
                )
                known.add(sensor)
            journal.append([JournalEntry(measurement, arrival.arrived_ns)])

        try:
            yield write
        except BaseException:
            if len(journal):
                click.echo(
                    f"the received measurements are safe in {path}; recover them with 'ertis import journals {path}'",
                    err=True,
                )
            else:
                journal.remove()
            raise
        if not len(journal):
            journal.remove()
            raise DataError(
                f"{target} is not written, because no measurement was received; check 'ertis sensors status', or run "
                "the command longer"
            )
    sealed = seal_in_subprocess(path, overwrite=overwrite)
    if sealed.recording is None:
        raise DataError(sealed.remark)
