"""Microphone signals for and from Acoular: an HDF5 file of signals, and an XML file of the array.

The files follow `acoular.TimeSamples` and `acoular.MicGeom` of Acoular 24 to 26 (https://www.acoular.org).
"""

from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.atomic_files import require_free_space
from ertis_numba.errors import DamagedError, DataError, ForeignDataError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import Layout, microphones, received_settings, self_contained
from ertis_numba.settings import Array, Recording, Settings
from ertis_numba.stages.signals import signals_of
from ertis_numba.storage.structure import local_member, require_attributes, stored_bytes

__all__ = ["read_acoular", "write_acoular"]


def write_acoular(path: Path, geometry: Path, measurement: Measurement) -> None:
    """Write the signals of a measurement, and the positions of its microphones.

    Signals are divided by the calibrated gains; calibrated delays are left in. Positions are in the sensor frame, x
    forward, y left and z up, in metres.
    """
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


def read_acoular(path: Path) -> tuple[float, NDArray[Any], Settings | None]:
    """Return the sample rate in Hz, the signals, (sample, channel), and the settings of a file from `write_acoular`.

    The settings describe the file's content: only enabled microphones, without gains, because the signals are divided
    by them, and ranges counted in its samples. For other files they are None.

    Raises
    ------
    DataError
        The file is not an Acoular file, or its data has another type or shape.
    """
    try:
        with h5py.File(path, "r") as file:
            data = local_member(file, "time_data", h5py.Dataset)
            require_attributes(data)
            stored_bytes(data, may_be_filtered=True)
            numbers = np.asarray(data[()])
            rates_hz = np.asarray(data.attrs["sample_freq"], dtype=np.float64)
            reported = None
            if "metadata" in file:
                reported = local_member(file, "metadata", h5py.Group).attrs.get("settings")
    except (DamagedError, ForeignDataError) as error:
        raise DataError(f"{path}: {error}") from error
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(
            f"{path} contains no time_data with a sample_freq; give a file of Acoular, or process a recording "
            "with 'ertis process'"
        ) from error
    if rates_hz.size != 1:
        raise DataError(f"{path}: sample_freq is {rates_hz.tolist()}; give one number, the rate in Hz")
    rate_hz = float(rates_hz.item())
    numbers = numbers[:, None] if numbers.ndim == 1 else numbers
    if numbers.ndim != 2 or not numbers.size or numbers.dtype.kind not in "fi":
        raise DataError(
            f"{path}: time_data is {numbers.dtype} of shape {numbers.shape}; give floating or signed numbers of shape "
            "(sample, channel)"
        )
    return (
        rate_hz,
        numbers,
        None if reported is None else _of_signals(received_settings(str(reported), str(path)), rate_hz),
    )


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
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', f'<MicArray name="{name}">', *rows, "</MicArray>", ""])
