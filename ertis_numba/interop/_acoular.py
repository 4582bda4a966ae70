"""Microphone signals for and from Acoular: an HDF5 file of signals, and an XML file of the array.

The files follow `acoular.TimeSamples` and `acoular.MicGeom` of Acoular 24 to 26 (https://www.acoular.org).
"""

from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.atomic_files import require_free_space
from ertis_numba.base.errors import DataError
from ertis_numba.base.wav import Samples
from ertis_numba.chain.signals import signals_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import SENSOR_FRAME, Layout, microphones, received_settings, self_contained
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Array, Recording, Settings
from ertis_numba.storage.opening import open_file, reading
from ertis_numba.storage.structure import local_member, require_attributes, stored_bytes
from ertis_numba.storage.variables import to_python

__all__ = ["read_acoular", "write_acoular"]

_WANTED = "a file of Acoular"
_SAVE = "save WAV, or HDF5 with the dataset time_data, (sample, channel), and its attribute sample_freq"
_MAX_NAMES = 8


def write_acoular(path: Path, geometry: Path, measurement: Measurement) -> None:
    """Write signals divided by the calibrated gains, delays left in, and positions x forward, y left, z up, in m."""
    layout = microphones(measurement.settings.array)
    signals = signals_of(measurement)
    geometry.write_text(_xml(layout), encoding="utf-8")
    require_free_space(path.parent, signals.nbytes)  # HDF5 can crash the process on a full disk.
    with h5py.File(path, "w") as file:
        samples = file.create_dataset("time_data", data=signals.T)
        samples.attrs["sample_freq"] = measurement.settings.signal_rate_hz
        facts = file.create_group("metadata").attrs
        facts["settings"] = self_contained(measurement.settings).to_toml()
        facts["sound_speed_m_s"] = sound_speed_m_s(measurement.settings.air)
        for name, value in asdict(measurement.stamp).items():
            facts[name] = value


def read_acoular(path: Path) -> tuple[float, Samples, Settings | None]:
    """Return sample rate in Hz, lazily read signals (sample, channel), and settings of own files, otherwise None."""
    with open_file(path, _WANTED) as file, reading(file, path):
        data = _time_data(file, path)
        shape = (*data.shape, 1) if data.ndim == 1 else data.shape
        samples = _Stored(path, shape, data.dtype)
        rates_hz = _numbers(data.attrs["sample_freq"])
        reported = _settings(file)
    if rates_hz is None or rates_hz.size != 1:
        raise DataError(
            f"{path}: sample_freq is {'not a number' if rates_hz is None else rates_hz.tolist()}; store one "
            "number, the sample rate in Hz"
        )
    rate_hz = float(rates_hz.item())
    if len(shape) != 2 or not all(shape) or samples.dtype.kind not in "fi":
        raise DataError(
            f"{path}: time_data is {samples.dtype} of shape {shape}; store floating-point or signed numbers of shape "
            "(sample, channel)"
        )
    return rate_hz, samples, _of_signals(received_settings(reported, str(path)), rate_hz) if reported else None


@dataclass(frozen=True, slots=True)
class _Stored:
    """Signals in a file, which is opened for each slice."""

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def __getitem__(self, samples: slice) -> NDArray[Any]:
        with open_file(self.path, _WANTED) as file, reading(file, self.path):
            numbers = np.asarray(_time_data(file, self.path)[samples])
        return numbers[:, None] if numbers.ndim == 1 else numbers


def _time_data(file: h5py.File, path: Path) -> h5py.Dataset:
    """Return the signals; refuse a file without them, or without their rate."""
    if "ertis_format" in file.attrs:
        raise DataError(f"{path} is a file of this package, which needs no import; use 'ertis process' or 'ertis info'")
    if "time_data" not in file:
        names = ", ".join(sorted(file)[:_MAX_NAMES]) or "nothing"
        raise DataError(f"{path} contains no time_data with a sample_freq, but {names}; {_SAVE}")
    data = local_member(file, "time_data", h5py.Dataset)
    require_attributes(data)
    if data.shape is None:
        raise DataError(f"{path}: time_data is empty; {_SAVE}")
    if "sample_freq" not in data.attrs:
        raise DataError(f"{path}: time_data has no attribute sample_freq, the rate in Hz; {_SAVE}")
    stored_bytes(data, may_be_filtered=True)
    return data


def _numbers(value: Any) -> NDArray[np.float64] | None:
    """Return an attribute as numbers; None if it has another type or no data."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def _settings(file: h5py.File) -> str:
    """Return the settings in files from `write_acoular`; empty for those of Acoular."""
    if "metadata" not in file:
        return ""
    facts = local_member(file, "metadata", h5py.Group).attrs
    return str(to_python(facts["settings"])) if "settings" in facts else ""


def _of_signals(settings: Settings, rate_hz: float) -> Settings:
    """Return the settings of a recording for the signals computed from it."""
    layout, step = microphones(settings.array), round(settings.recording.sample_rate_hz / rate_hz)
    array = Array(
        layout=layout.name,
        positions_m=tuple((float(x), float(y), float(z)) for x, y, z in layout.enabled_positions_m),
        delay_s=tuple(layout.delay_s[layout.enabled].tolist()),
    )
    processing = settings.processing
    return settings.replace(
        array=array,
        recording=Recording(sample_rate_hz=rate_hz, n_samples=1, encoding="float32"),
        processing=processing.replace(range_decimation=max(1, processing.range_decimation // step), decimation=None),
    )


def _xml(layout: Layout) -> str:
    rows = [
        f'  <pos Name="channel {channel}" x="{x!r}" y="{y!r}" z="{z!r}"/>'
        for channel, (x, y, z) in enumerate(layout.positions_m.tolist())
        if layout.enabled[channel]
    ]
    name = escape(layout.name)
    head = f'<MicArray name="{name}" axes="{SENSOR_FRAME}">'
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', head, *rows, "</MicArray>", ""])
