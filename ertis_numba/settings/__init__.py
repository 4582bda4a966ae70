"""Settings of a sensor, as frozen structures that are read from TOML and written to it.

A structure checks its values when it is created and refuses unknown keys. ``Settings()`` describes the default eRTIS
measurement; ``Settings.from_preset`` returns the settings of an RTIS recording preset, and ``Processing.from_preset``
those of a processing preset.
"""

from ertis_numba.settings.accuracy import ERROR_PRESETS_DB, MAX_FOCAL_ZONES, Accuracy
from ertis_numba.settings.array import (
    LAYOUT_SUFFIXES,
    LENGTH_UNITS_M,
    MAX_EMITTER_M,
    MAX_SPAN_M,
    MIN_SPAN_M,
    OWN_ARRAY,
    Array,
)
from ertis_numba.settings.array_windows import ArrayWindow, parse_window
from ertis_numba.settings.call import MAX_CALL_SAMPLES, Call
from ertis_numba.settings.excluded_channels import ExcludedChannels
from ertis_numba.settings.passive import HIGHEST_SHARE, MAP_METHODS, MAX_BANDS, MapMethod, Passive
from ertis_numba.settings.presets import PRESETS, PresetKind, preset_tables, preset_text, presets
from ertis_numba.settings.processing import STAGES, Processing
from ertis_numba.settings.ranges import fit_ranges, record_range_m
from ertis_numba.settings.recording import ENCODINGS, Air, Recording
from ertis_numba.settings.settings import Settings
from ertis_numba.settings.waveform import MAX_WAVEFORM_SAMPLES

__all__ = [
    "ENCODINGS",
    "ERROR_PRESETS_DB",
    "HIGHEST_SHARE",
    "LAYOUT_SUFFIXES",
    "LENGTH_UNITS_M",
    "MAP_METHODS",
    "MAX_BANDS",
    "MAX_CALL_SAMPLES",
    "MAX_EMITTER_M",
    "MAX_FOCAL_ZONES",
    "MAX_SPAN_M",
    "MAX_WAVEFORM_SAMPLES",
    "MIN_SPAN_M",
    "OWN_ARRAY",
    "PRESETS",
    "STAGES",
    "Accuracy",
    "Air",
    "Array",
    "ArrayWindow",
    "Call",
    "ExcludedChannels",
    "MapMethod",
    "Passive",
    "PresetKind",
    "Processing",
    "Recording",
    "Settings",
    "fit_ranges",
    "parse_window",
    "preset_tables",
    "preset_text",
    "presets",
    "record_range_m",
]
