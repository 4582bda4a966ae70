"""Readers and writers of foreign formats."""

from ertis_numba.interop._export import FORMATS, TOPICS, export, output_files, choose_format
from ertis_numba.interop.pcm import PcmReader, open_pcm
from ertis_numba.interop.rtis import RawReader, open_raw
from ertis_numba.interop.rtis_folder import open_rtis_folder

__all__ = [
    "FORMATS",
    "TOPICS",
    "PcmReader",
    "RawReader",
    "export",
    "output_files",
    "choose_format",
    "open_pcm",
    "open_raw",
    "open_rtis_folder",
]
