"""Everything that can be chosen, as frozen structures with TOML in and out.

A structure checks itself once, when it is made; whoever holds one may rely on it. Unknown keys are
refused. ``Settings()`` is the default eRTIS measurement; ``Settings.from_preset`` knows the RTIS
recording presets.
"""

from ertis_numba.settings.accuracy import ERROR_PRESETS_DB, INTERPOLATIONS, MAX_ZONES, Accuracy
from ertis_numba.settings.array import Array
from ertis_numba.settings.call import MAX_CALL_SAMPLES, Call
from ertis_numba.settings.processing import Processing
from ertis_numba.settings.ranges import suit_ranges
from ertis_numba.settings.recording import ENCODINGS, Air, Recording
from ertis_numba.settings.settings import PRESETS, Settings
from ertis_numba.settings.tapers import Taper, taper_of
from ertis_numba.settings.waveform import MAX_WAVEFORM_SAMPLES

__all__ = [
    "ENCODINGS",
    "ERROR_PRESETS_DB",
    "INTERPOLATIONS",
    "MAX_CALL_SAMPLES",
    "MAX_WAVEFORM_SAMPLES",
    "MAX_ZONES",
    "PRESETS",
    "Accuracy",
    "Air",
    "Array",
    "Call",
    "Processing",
    "Recording",
    "Settings",
    "Taper",
    "suit_ranges",
    "taper_of",
]
