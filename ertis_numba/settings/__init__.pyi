# Public names, declared once: __init__.py imports each of them at its first use.

from .accuracy import (
    ERROR_PRESETS_DB as ERROR_PRESETS_DB,
    MAX_FOCAL_ZONES as MAX_FOCAL_ZONES,
    Accuracy as Accuracy,
)
from .array import (
    LAYOUT_SUFFIXES as LAYOUT_SUFFIXES,
    LENGTH_UNITS_M as LENGTH_UNITS_M,
    MAX_EMITTER_M as MAX_EMITTER_M,
    MAX_SPAN_M as MAX_SPAN_M,
    MIN_SPAN_M as MIN_SPAN_M,
    OWN_ARRAY as OWN_ARRAY,
    Array as Array,
)
from .array_windows import (
    ArrayWindow as ArrayWindow,
    parse_window as parse_window,
)
from .call import (
    MAX_CALL_SAMPLES as MAX_CALL_SAMPLES,
    Call as Call,
)
from .excluded_channels import (
    ExcludedChannels as ExcludedChannels,
)
from .map_methods import (
    MAP_METHODS as MAP_METHODS,
    MapMethod as MapMethod,
    MapMethodName as MapMethodName,
)
from .passive import (
    HIGHEST_SHARE as HIGHEST_SHARE,
    MAX_BANDS as MAX_BANDS,
    Passive as Passive,
)
from .preset_files import (
    PRESETS as PRESETS,
    PresetKind as PresetKind,
    preset_tables as preset_tables,
    preset_text as preset_text,
    presets as presets,
)
from .processing import (
    STAGES as STAGES,
    Processing as Processing,
)
from .ranges import (
    fit_ranges as fit_ranges,
    record_range_m as record_range_m,
)
from .recording import (
    ENCODINGS as ENCODINGS,
    Air as Air,
    Recording as Recording,
)
from .settings import (
    Settings as Settings,
)
from .waveform import (
    MAX_WAVEFORM_SAMPLES as MAX_WAVEFORM_SAMPLES,
)
