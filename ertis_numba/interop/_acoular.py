"""Microphone signals for Acoular: an HDF5 file of them, and an XML file of the array.

What `acoular.TimeSamples` and `acoular.MicGeom` of Acoular 24 to 26 read (https://www.acoular.org).
"""

from dataclasses import asdict
from html import escape
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.air import sound_speed_m_s
from ertis_numba.atomic import require_room
from ertis_numba.frames import Measurement
from ertis_numba.geometry import Layout, microphones, self_contained
from ertis_numba.stages.fast import chain_taps

__all__ = ["signals_of", "write_acoular"]


def write_acoular(path: Path, geometry: Path, measurement: Measurement) -> None:
    """Write the signals of a measurement, and the positions of the microphones that they come from.

    Positions are in the sensor frame, x forward, y left and z up, in metres.
    """
    layout = microphones(measurement.settings.array)
    signals = signals_of(measurement)
    geometry.write_text(_xml(layout), encoding="utf-8")
    require_room(path.parent, signals.nbytes)  # HDF5 on a full disk can take the process with it
    with h5py.File(path, "w") as file:
        samples = file.create_dataset("time_data", data=signals.T)
        samples.attrs["sample_freq"] = measurement.settings.signal_rate_hz
        facts = file.create_group("metadata").attrs
        facts["settings"] = self_contained(measurement.settings).to_toml()
        facts["sound_speed_m_s"] = sound_speed_m_s(measurement.settings.air)
        for name, value in asdict(measurement.stamp).items():
            facts[name] = value


def signals_of(measurement: Measurement) -> NDArray[np.float32]:
    """Return the demodulated signals of the enabled microphones: (mic, sample) float32, full scale 1.

    Sample n is the one at the PDM word n times the decimation. They are low-passed and divided by the calibrated
    gain; calibrated delays are left in.
    """
    settings = measurement.settings
    layout = microphones(settings.array)
    channels = np.flatnonzero(layout.enabled).astype(np.int32)
    taps = chain_taps(settings)
    count = -(-settings.recording.n_samples // settings.decimation)
    signals = np.zeros((len(channels), count), dtype=np.float32)
    # All devices give the same bits, and this one has nothing to compile.
    kernels.load("numpy").demodulate_words(
        measurement.words.reshape(settings.recording.n_samples, -1),
        channels,
        taps,
        np.float32(1 / taps.sum(dtype=np.int64)),
        settings.decimation,
        0,
        count,
        signals,
    )
    signals /= layout.gain[layout.enabled, None].astype(np.float32)
    return signals


def _xml(layout: Layout) -> str:
    rows = [
        f'  <pos Name="channel {channel}" x="{x!r}" y="{y!r}" z="{z!r}"/>'
        for channel, (x, y, z) in enumerate(layout.positions_m.tolist())
        if layout.enabled[channel]
    ]
    name = escape(layout.name)
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', f'<MicArray name="{name}">', *rows, "</MicArray>", ""])
