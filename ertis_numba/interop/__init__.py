"""Foreign formats."""

from ertis_numba.interop.rtis import RawReader, open_raw

__all__ = ["RawReader", "open_raw"]
