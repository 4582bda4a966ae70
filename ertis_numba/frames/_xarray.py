"""Conversion to xarray, with the names of dimensions and coordinates that recordings and energyscape files have."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.extras import extra
from ertis_numba.frames._stamp import Stamp
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    import xarray

__all__ = ["data_array"]


def data_array(
    name: str,
    values: NDArray[Any],
    dims: tuple[str, ...],
    coords: Mapping[str, tuple[str, NDArray[Any], str, str]],
    *,
    about: str,
    settings: Settings,
    stamp: Stamp,
    **further: float,
) -> "xarray.DataArray":
    """Return a labelled array that shares memory with values; coords: (dimension, values, description, unit)."""
    # The settings become an attribute as TOML, and the time a scalar coordinate for `xarray.concat`.
    with extra("xarray", "to_xarray needs xarray"):
        import xarray as xr  # noqa: PLC0415  an optional dependency
    labels: dict[str, Any] = {
        key: (dim, array, {"long_name": text} | ({"units": unit} if unit else {}))
        for key, (dim, array, text, unit) in coords.items()
    }
    labels["time"] = ((), np.datetime64(stamp.timestamp_ns, "ns"), {"long_name": "start of the emission"})
    attributes = {
        "long_name": about,
        "sensor": stamp.sensor,
        "sequence": stamp.sequence,
        "sync_count": stamp.sync_count,
        "session_id": stamp.session_id,
        "timestamp_uncertainty_ns": stamp.timestamp_uncertainty_ns,
        "behaviour": stamp.behaviour,
        "settings": settings.to_toml(),
        **further,
    }
    return xr.DataArray(values, coords=labels, dims=dims, name=name, attrs=attributes)
