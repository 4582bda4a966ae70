"""Output files that appear complete or not at all, and removal of empty new folders."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape, Measurement
    from ertis_numba.network.products import Arrival

__all__ = ["PRODUCTS", "saving", "withdrawn"]

PRODUCTS = ("energyscape", "raw")
"""Products that can be saved."""

Write = Callable[["Arrival"], None]


@contextmanager
def withdrawn(*folders: Path | None) -> Iterator[list[Path]]:
    """Yield the folders that do not exist yet; remove them afterwards if the block raises an error.

    Clear the list once the folders are in use. A folder with other files than a central node's own stays.
    """
    missing = [each for folder in folders if folder for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield missing
    except BaseException:
        for folder in missing:  # The deepest folders come first.
            with suppress(OSError):
                found = list(folder.iterdir())
                if all(path.name.startswith(".ertis-") for path in found):
                    for path in found:
                        path.unlink()
                    folder.rmdir()
        raise


@contextmanager
def saving(target: Path | None, product: str, *, overwrite: bool) -> Iterator[Write]:
    """Yield a function that saves each product; the file appears if the block succeeds.

    Raises
    ------
    ArgumentError
        The file cannot be written, or there is nothing to save.
    """
    if target is None:
        yield lambda _: None
        return
    _require_place(target)
    if product == "energyscape":
        from ertis_numba.storage import EnergyscapeWriter

        with EnergyscapeWriter(target, overwrite=overwrite) as writer:
            mounted: set[str] = set()

            def write(arrival: "Arrival") -> None:
                image = cast("Energyscape", arrival.item)  # The subscription requests this product only.
                if image.stamp.sensor not in mounted:
                    mounted.add(image.stamp.sensor)
                    if arrival.translation_m is not None and arrival.rotation_xyzw is not None:
                        writer.note_mounting(image.stamp.sensor, arrival.translation_m, arrival.rotation_xyzw)
                writer.write(image)

            yield write
        return
    yield from _recording(target, overwrite=overwrite)


def _require_place(target: Path) -> None:
    """Refuse a file whose folder is missing or not writable, before waiting for anything."""
    from ertis_numba.errors import ArgumentError

    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise ArgumentError(
            f"--save {target}: folder {target.parent} is not writable ({error.strerror}); make it writable or "
            "give another"
        ) from error


def _recording(target: Path, *, overwrite: bool) -> Iterator[Write]:
    """Yield a function that stores measurements in a journal, which then becomes a recording."""
    from ertis_numba.atomic_files import check_target
    from ertis_numba.errors import DataError
    from ertis_numba.journal import SUFFIX, Entry, Journal, seal_apart

    check_target(target, overwrite=overwrite)
    path = target.with_name(f"{target.name}{SUFFIX}")
    known: set[str] = set()
    with Journal.create(path, target=target.name, source="received from a central node") as journal:
        if journal.remark:
            click.echo(f"ertis: warning: {journal.remark}", err=True)

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
            journal.append([Entry(measurement, arrival.arrived_ns)])

        try:
            yield write
        except BaseException:
            if len(journal):
                click.echo(
                    f"received measurements are safe in {path}; recover them with 'ertis recover {path}'", err=True
                )
            else:
                journal.remove()
            raise
        if not len(journal):
            journal.remove()
            raise DataError(f"{target} would contain no measurement; wait until one arrives")
    sealed = seal_apart(path, overwrite=overwrite)
    if sealed.recording is None:
        raise DataError(sealed.remark)
