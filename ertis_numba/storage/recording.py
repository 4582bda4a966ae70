"""Recordings: measurements as they came from the microphones, and what is needed to process them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import Layout, microphones
from ertis_numba.settings import Air, Settings
from ertis_numba.storage._reader import Reader
from ertis_numba.storage._rows import RowWriter
from ertis_numba.storage._writer import Writer, self_contained
from ertis_numba.storage.schema import RECORDING, Variable, describe, lay_out
from ertis_numba.storage.truth import Truth, read_truth, write_truth
from ertis_numba.waveform import call_samples

__all__ = ["Gap", "RecordingReader", "RecordingWriter", "open_recording", "write_recording"]

_AIR = {"temperature": "temperature_c", "humidity": "humidity_percent", "pressure": "pressure_pa"}


@dataclass(frozen=True, slots=True)
class Gap:
    """Sequence numbers that are missing, ``first`` and ``last`` included, and why."""

    first: int
    last: int
    reason: str


class RecordingWriter(Writer[Measurement]):
    """Writes a recording measurement by measurement; use it in a ``with`` statement.

    Parameters
    ----------
    path : str or Path
    settings : Settings, optional
        Those of the first measurement by default. Layout files are written out into the recording.
    overwrite : bool
        Replace a file of this name.
    source : str
        Where the measurements come from.
    truth : Truth, optional
        What a simulated recording should show.
    """

    _kind: ClassVar[str] = "recording"
    _data: ClassVar[str] = "pdm"
    _table: ClassVar[tuple[Variable, ...]] = RECORDING

    def __init__(
        self,
        path: str | Path,
        *,
        settings: Settings | None = None,
        overwrite: bool = False,
        source: str = "",
        truth: Truth | None = None,
    ) -> None:
        super().__init__(path, overwrite=overwrite, attributes={"source": source, "history": ""})
        self._settings = settings
        self._checked = settings
        self._truth = truth

    def _begin(self, group: h5py.Group, first: Measurement) -> None:
        given = self._settings or first.settings
        if given.processing.directions.lower().endswith(".csv"):
            raise ArgumentError(
                f"processing.directions is the file {given.processing.directions}, which a recording cannot hold; "
                "name a grid, and give the file when processing"
            )
        self._settings = settings = self_contained(given)
        layout = microphones(settings.array)
        samples = call_samples(settings.call)
        several = {"word": layout.n_words} if layout.n_words > 1 else {}
        sizes = {
            "sample": settings.recording.n_samples,
            "microphone": len(layout.enabled),
            "axis": 3,
            "call_sample": len(samples),
            **several,
        }
        lay_out(
            group,
            RECORDING,
            sizes=sizes,
            dtypes={"pdm": f"<u{layout.word_bits // 8}"},
            texts={"settings": settings.to_toml()},
        )
        describe(group, _mounting(first.stamp.sensor, settings))
        describe(group["pdm"], {"sample_rate_hz": settings.recording.pdm_rate_hz, "bit_order": "lsb_first"})
        describe(group["call"], {"sample_rate_hz": settings.call.sample_rate_hz})
        group["microphone"][:] = np.arange(len(layout.enabled))
        group["call"][:] = samples
        for name, values in _copies(layout).items():
            group[name][:] = values
        if self._truth is not None:
            write_truth(group.file, self._truth)

    def _row(self, item: Measurement) -> tuple[NDArray[Any], dict[str, float]]:
        self._require_same(item.settings)
        air = item.settings.air
        return item.words, {name: getattr(air, field) for name, field in _AIR.items()}

    def _require_same(self, settings: Settings) -> None:
        """Refuse what one set of settings cannot describe: all but the air must be equal."""
        if settings is self._checked or self._settings is None:
            return
        came = self_contained(settings)
        for name in ("array", "call", "recording"):
            if getattr(came, name) != getattr(self._settings, name):
                raise ArgumentError(f"a measurement has other {name} settings than the recording; write it to its own")
        self._checked = settings

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        values: dict[str, list[Any]] = {
            "gap": [0.0] * len(rows.gaps),
            "gap_first": [first for first, _ in rows.gaps],
            "gap_last": [last for _, last in rows.gaps],
            "gap_reason": ["not among the measurements given"] * len(rows.gaps),
        }
        for name, column in values.items():
            group[name].resize((len(rows.gaps),))
            if len(column):
                group[name][:] = column


def _copies(layout: Layout) -> dict[str, NDArray[Any]]:
    """Return the arrays that repeat the settings for programs that read no TOML."""
    return {
        "microphone_position": layout.positions_m,
        "microphone_enabled": layout.enabled.astype(np.int8),
        "calibration_gain": layout.gain,
        "calibration_delay": layout.delay_s,
    }


def _mounting(sensor: str, settings: Settings) -> dict[str, Any]:
    """Return who the sensor is and how it is mounted: at the origin, as long as nobody says more."""
    return {
        "serial_number": sensor,
        "model": settings.array.layout,
        "firmware": "",
        "frame_id": sensor,
        "translation_m": np.zeros(3),
        "rotation_xyzw": np.array([0.0, 0.0, 0.0, 1.0]),
    }


class RecordingReader(Reader[Measurement]):
    """A recording as a sequence of measurements, read one at a time.

    Attributes
    ----------
    gaps : tuple of Gap
    truth : Truth or None
        What a simulated recording should show.
    """

    _kind: ClassVar[str] = "recording"
    _data: ClassVar[str] = "pdm"
    _table: ClassVar[tuple[Variable, ...]] = RECORDING

    gaps: tuple[Gap, ...]
    truth: Truth | None

    def _load(self) -> None:
        self._require_agreement()
        columns = (self._group[f"gap_{name}"][:] for name in ("first", "last", "reason"))
        self.gaps = tuple(
            Gap(int(first), int(last), reason.decode()) for first, last, reason in zip(*columns, strict=True)
        )
        self.truth = read_truth(self._file)

    def _item(self, index: int) -> Measurement:
        air = Air(**{field: self._rows.column(name, index) for name, field in _AIR.items()})
        settings = self.settings if air == self.settings.air else self.settings.replace(air=air)
        return Measurement(self._rows.row(index), settings, self._rows.stamp(index, self.sensor))

    def _sizes(self) -> dict[str, int]:
        layout = microphones(self.settings.array)
        several = {"word": layout.n_words} if layout.n_words > 1 else {}
        return {
            "sample": self.settings.recording.n_samples,
            "microphone": len(layout.enabled),
            "axis": 3,
            **several,
        }

    def _require_agreement(self) -> None:
        """Refuse a file whose arrays say something else than its settings, which are what is used."""
        for name, wanted in _copies(microphones(self.settings.array)).items():
            values = self._group[name][:]
            wrong = np.argwhere(values != wanted)  # NaN, too
            if wrong.size:
                place = tuple(wrong[0])
                raise DataError(
                    f"{self.path}: {name} of channel {place[0]} is {values[place]:g}, the settings in the file say "
                    f"{wanted[place]:g}; change the settings with it"
                )


def open_recording(path: str | Path, *, sensor: str | None = None) -> RecordingReader:
    """Open a recording for reading.

    Parameters
    ----------
    path : str or Path
    sensor : str, optional
        Which one, where a file holds several.

    Raises
    ------
    DataError
        The file is not a recording, is damaged or cut short.
    FormatVersionError
        A newer version wrote it.
    ArgumentError
        There is no such sensor, or there are several and none is chosen.
    """
    return RecordingReader(path, sensor=sensor)


def write_recording(
    path: str | Path,
    measurements: Iterable[Measurement],
    *,
    settings: Settings | None = None,
    overwrite: bool = False,
    source: str = "",
    truth: Truth | None = None,
) -> Path:
    """Write measurements as they come and return the path; the arguments are those of `RecordingWriter`.

    Raises
    ------
    ArgumentError
        There is no measurement, one does not fit to the others, or the file exists.
    DataError
        The disk is full or cannot be written.
    """
    with RecordingWriter(path, settings=settings, overwrite=overwrite, source=source, truth=truth) as writer:
        for measurement in measurements:
            writer.write(measurement)
    return writer.path
