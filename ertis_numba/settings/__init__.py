"""Everything that can be chosen, as frozen structures with TOML in and out.

A structure checks itself once, when it is made; whoever holds one may rely on it. Unknown keys are
refused. ``Settings()`` is the default eRTIS measurement; ``Settings.from_preset`` knows the RTIS
recording presets.
"""

from ertis_numba.settings.accuracy import ERROR_PRESETS_DB, INTERPOLATIONS, MAX_FOCAL_ZONES, Accuracy
from ertis_numba.settings.array import Array
from ertis_numba.settings.call import MAX_CALL_SAMPLES, Call
from ertis_numba.settings.processing import Processing
from ertis_numba.settings.ranges import fit_ranges
from ertis_numba.settings.recording import ENCODINGS, Air, Recording
from ertis_numba.settings.settings import PRESETS, Settings
from ertis_numba.settings.waveform import MAX_WAVEFORM_SAMPLES
from ertis_numba.settings.windows import ArrayWindow, parse_window

__all__ = [
    "ENCODINGS",
    "ERROR_PRESETS_DB",
    "INTERPOLATIONS",
    "MAX_CALL_SAMPLES",
    "MAX_FOCAL_ZONES",
    "MAX_WAVEFORM_SAMPLES",
    "PRESETS",
    "Accuracy",
    "Air",
    "Array",
    "ArrayWindow",
    "Call",
    "Processing",
    "Recording",
    "Settings",
    "fit_ranges",
    "parse_window",
]
