"""What was received, as a file: complete when it ends, or not at all."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape, Measurement
    from ertis_numba.network.products import Arrival

__all__ = ["PRODUCTS", "saving"]

PRODUCTS = ("energyscape", "raw")
"""What there are files for."""

Write = Callable[["Arrival"], None]


@contextmanager
def saving(target: Path | None, product: str, *, overwrite: bool) -> Iterator[Write]:
    """Yield what takes each product; the file is there when the block has ended well.

    Raises
    ------
    ArgumentError
        The file cannot be put there, or there is nothing to put into it.
    """
    if target is None:
        yield lambda _: None
        return
    if product == "energyscape":
        from ertis_numba.storage import EnergyscapeWriter

        with EnergyscapeWriter(target, overwrite=overwrite) as writer:
            yield lambda arrival: writer.write(cast("Energyscape", arrival.item))  # as was asked
        return
    yield from _recording(target, overwrite=overwrite)


def _recording(target: Path, *, overwrite: bool) -> Iterator[Write]:
    """Yield what takes measurements into a journal, which then becomes a recording, as a capture does it."""
    from ertis_numba.atomic import check_target
    from ertis_numba.errors import DataError
    from ertis_numba.journal import SUFFIX, Entry, Journal, seal_apart

    check_target(target, overwrite=overwrite)
    path = target.with_name(f"{target.name}{SUFFIX}")
    known: set[str] = set()
    with Journal.create(path, target=target.name, source="received from a central node") as journal:

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
                click.echo(f"what came is safe in {path}; seal it by 'ertis recover {path}'", err=True)
            else:
                journal.remove()
            raise
        if not len(journal):
            journal.remove()
            raise DataError(f"{target} would hold no measurement; wait until one comes")
    sealed = seal_apart(path, overwrite=overwrite)
    if sealed.recording is None:
        raise DataError(sealed.remark)
