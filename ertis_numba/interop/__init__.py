"""Readers and writers of foreign formats."""

from ertis_numba.interop._drive import Drive
from ertis_numba.interop._export import FORMATS, TOPICS, choose_format, export, output_files
from ertis_numba.interop._map_files import MAP_SUFFIXES, map_files, write_map
from ertis_numba.interop.pcm import open_pcm
from ertis_numba.interop.pcm_reader import PcmReader
from ertis_numba.interop.raw_pdm import RawReader, open_raw
from ertis_numba.interop.rtis_folder import open_rtis_folder
from ertis_numba.interop.trajectory_files import check_tum_target, read_trajectory, write_tum

__all__ = [
    "FORMATS",
    "MAP_SUFFIXES",
    "TOPICS",
    "Drive",
    "PcmReader",
    "RawReader",
    "check_tum_target",
    "choose_format",
    "export",
    "map_files",
    "open_pcm",
    "open_raw",
    "open_rtis_folder",
    "output_files",
    "read_trajectory",
    "write_map",
    "write_tum",
]
