# Public names; __init__.py imports each of them at its first use.

from ._drive import Drive as Drive
from ._export import (
    choose_format as choose_format,
    export as export,
    output_files as output_files,
    require_options as require_options,
)
from ._map_files import MAP_SUFFIXES as MAP_SUFFIXES, map_files as map_files, write_map as write_map
from .export_formats import EXPORT_FORMATS as EXPORT_FORMATS, FORMATS as FORMATS, TOPICS as TOPICS
from .pcm import open_pcm as open_pcm
from .pcm_reader import PcmReader as PcmReader
from .raw_pdm import RawReader as RawReader, open_raw as open_raw
from .rtis_folder import open_rtis_folder as open_rtis_folder
from .trajectory_files import (
    check_tum_target as check_tum_target,
    read_trajectory as read_trajectory,
    write_tum as write_tum,
)
