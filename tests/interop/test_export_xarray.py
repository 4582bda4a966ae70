"""xarray opens recordings and energyscape files by h5netcdf and by netCDF4."""

import numpy as np
import pytest

from ertis_numba.storage import write_energyscapes, write_recording
from ertis_numba.storage.schema import ENERGYSCAPE, RECORDING
from tests.files import image, line, noise, open_dataset


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
@pytest.mark.parametrize("settings", [line(8, 8), line(70, 16)], ids=["8", "70 in 5 words"])
def test_xarray_opens_a_recording(tmp_path, engine, settings):
    given = noise(settings)
    path = write_recording(tmp_path / "rec.h5", given)
    with open_dataset(path, group="/sensors/eRTIS-7", engine=engine) as data:
        assert data["pdm"].dims == ("time", "sample", "word")[: given[0].data.ndim + 1]
        assert np.array_equal(data["pdm"].values, [each.data for each in given])
        assert data["microphone_position"].dims == ("microphone", "axis")
        assert data["time"].values[0] == np.datetime64(1_700_000_000_123_456_789, "ns")
        assert {*data.variables} == {variable.name for variable in RECORDING}


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_xarray_opens_energyscapes(tmp_path, engine):
    path = write_energyscapes(tmp_path / "img.h5", [image(), image(seed=2)])
    with open_dataset(path, group="/sensors/sensor", engine=engine) as data:
        assert data["amplitude"].dims == ("time", "direction", "range")
        assert np.array_equal(data["amplitude"].values, [image().amplitude, image(seed=2).amplitude])
        assert {*data.coords} == {"azimuth", "elevation", "range", "time"}
        assert data["range"].attrs["units"] == "m"
        nearest = data["amplitude"].isel(time=0).max("direction").idxmax("range")
        assert float(nearest) == image().range_m[200]
        assert {*data.variables} == {variable.name for variable in ENERGYSCAPE}


def test_float16_is_read_by_h5netcdf(tmp_path):
    """netCDF-C crashes on it, as docs/reference/formats.md states."""
    path = write_energyscapes(tmp_path / "img.h5", [image()], dtype="float16")
    with open_dataset(path, group="/sensors/sensor", engine="h5netcdf") as data:
        np.testing.assert_allclose(data["amplitude"].values[0], image().amplitude, rtol=2**-10, atol=1e-7)
