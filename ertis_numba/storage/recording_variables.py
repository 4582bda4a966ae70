"""Variables of a recording that repeat its settings."""

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import Layout, microphones
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Settings
from ertis_numba.storage._mounting import write_mounting
from ertis_numba.storage.schema import RECORDING, RECORDING_OF_PCM, Variable
from ertis_numba.storage.variables import create_variables, set_attributes

__all__ = ["AIR", "axis_sizes", "create_sensor_variables", "data_and_table", "layout_arrays"]

AIR = {"temperature": "temperature_c", "humidity": "humidity_percent", "pressure": "pressure_pa"}


def create_sensor_variables(
    group: h5py.Group, settings: Settings, *, firmware: str, mounting: Mapping[str, Any]
) -> None:
    """Create all variables of a sensor, named by its group, without rows; ``mounting`` is empty if unknown."""
    layout, words, samples = microphones(settings.array), sample_format(settings), call_samples(settings.call)
    data, table = data_and_table(pdm=settings.recording.is_pdm)
    create_variables(
        group,
        table,
        sizes={**axis_sizes(settings), "call_sample": len(samples)},
        dtypes={data: words.dtype},
        texts={"settings": settings.to_toml()},
    )
    set_attributes(group, _identity(group.name.rpartition("/")[2], settings, firmware))
    write_mounting(group, mounting)
    bits = {"bit_order": "lsb_first"} if settings.recording.is_pdm else {}
    set_attributes(group[data], {"sample_rate_hz": settings.recording.sample_rate_hz, **bits})
    set_attributes(group["call"], {"sample_rate_hz": settings.call.sample_rate_hz})
    group["microphone"][:] = np.arange(len(layout.enabled))
    group["call"][:] = samples
    for name, values in layout_arrays(layout).items():
        group[name][:] = values


def data_and_table(*, pdm: bool) -> tuple[str, tuple[Variable, ...]]:
    """Return the name of the samples' variable, and the table of all variables."""
    return ("pdm", RECORDING) if pdm else ("pcm", RECORDING_OF_PCM)


def axis_sizes(settings: Settings) -> dict[str, int]:
    """Return the length that the settings give to each axis."""
    layout = microphones(settings.array)
    several = {"word": layout.n_words} if layout.n_words > 1 and settings.recording.is_pdm else {}
    return {"sample": settings.recording.n_samples, "microphone": len(layout.enabled), "axis": 3, **several}


def layout_arrays(layout: Layout) -> dict[str, NDArray[Any]]:
    """Return the arrays that repeat the settings for programs without a TOML parser."""
    return {
        "microphone_position": layout.positions_m,
        "microphone_enabled": layout.enabled.astype(np.int8),
        "calibration_gain": layout.gain,
        "calibration_delay": layout.delay_s,
    }


def _identity(sensor: str, settings: Settings, firmware: str) -> dict[str, Any]:
    """Return the identity of the sensor."""
    return {"serial_number": sensor, "model": settings.array.layout, "firmware": firmware, "frame_id": sensor}
