"""Energyscape files of 8-bit levels: external readers, limits, and damaged scales."""

import h5py
import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames.level_codes import LevelCodes
from ertis_numba.storage import open_energyscapes, write_energyscapes
from ertis_numba.storage.schema import ENERGYSCAPE_OF_LEVELS
from tests.files import image, open_dataset

HALF_DB = 0.251  # in single precision


def scaled(factor, seed=1):
    given = image(seed=seed)
    return given.replace(amplitude=given.amplitude * np.float32(factor))


def level_db(amplitude):
    with np.errstate(divide="ignore"):
        return 20 * np.log10(amplitude.astype(np.float64))


def floating(given):
    """The same image, of a recording with samples in floating point."""
    settings = given.settings
    return given.replace(settings=settings.replace(recording=settings.recording.replace(encoding="float32")))


def test_levels_are_read_back(tmp_path):
    given = [scaled(0.5), scaled(0.0), scaled(0.9, seed=2)]
    path = write_energyscapes(tmp_path / "img.h5", given, dtype="uint8")
    with open_energyscapes(path) as images:
        assert (images.dtype, images.level_step_db, len(images)) == ("uint8", 0.5, 3)
        for came, item in zip(images, given, strict=True):
            assert came.level_step_db == 0.5
            assert came.amplitude.dtype == np.float32
            is_heard = level_db(item.amplitude) > -122.2
            error_db = level_db(came.amplitude[is_heard]) - level_db(item.amplitude[is_heard])
            assert np.abs(error_db).max(initial=0) <= HALF_DB
            assert not came.amplitude[level_db(item.amplitude) < -122.3].any()
        rounded = images[0]
    again = write_energyscapes(tmp_path / "again.h5", [rounded], dtype="uint8")
    with open_energyscapes(again) as images:
        np.testing.assert_array_equal(images[0].amplitude, rounded.amplitude)


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_xarray_decodes_levels(tmp_path, engine):
    given = image()
    amplitude = given.amplitude.copy()
    amplitude[0, :7] = 0.0
    path = write_energyscapes(tmp_path / "img.h5", [given.replace(amplitude=amplitude)], dtype="uint8")
    with open_dataset(path, group="/sensors/sensor", engine=engine) as data:
        assert {*data.variables} == {variable.name for variable in ENERGYSCAPE_OF_LEVELS}
        level = data["level"]
        assert (level.dims, level.attrs["units"]) == (("time", "direction", "range"), "dB")
        assert np.isnan(level.values[0, 0, :7]).all()
        is_heard = amplitude > 0
        assert np.abs(level.values[0] - level_db(amplitude))[is_heard].max() <= HALF_DB
        assert not np.isnan(level.values[0][is_heard]).any()


def test_levels_are_a_formula_of_their_attributes(tmp_path):
    given = image()
    path = write_energyscapes(tmp_path / "img.h5", [given], dtype="uint8")
    with h5py.File(path) as file:
        level = file["sensors/sensor/level"]
        assert (level.dtype, level.attrs["_FillValue"]) == (np.uint8, 0)
        found_db = level.attrs["add_offset"] + level.attrs["scale_factor"] * level[0].astype(float)
    assert np.abs(found_db - level_db(given.amplitude)).max() <= HALF_DB


def test_first_image_selects_the_limits(tmp_path):
    loud = floating(scaled(1e3))
    path = write_energyscapes(tmp_path / "img.h5", [loud, loud], dtype="uint8")
    with open_energyscapes(path) as images:
        assert np.abs(level_db(images[1].amplitude) - level_db(loud.amplitude)).max() <= HALF_DB


def test_levels_beyond_the_limits_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"image 0 of sensor sensor: amplitudes .* do not fit 8-bit levels"):
        write_energyscapes(tmp_path / "img.h5", [scaled(0.5), scaled(1e3)], dtype="uint8")
    with pytest.raises(ArgumentError, match=r"first image of sensor sensor reaches -\d+\.\d dBFS, but 8-bit lev"):
        write_energyscapes(tmp_path / "img.h5", [floating(scaled(1e-7))], dtype="uint8")
    assert not (tmp_path / "img.h5").exists()


def test_float_files_keep_the_step_of_rounded_levels(tmp_path):
    """As images that were received in 8 bits, and saved."""
    levels = LevelCodes(-122.0)
    given = image()
    rounded = given.replace(amplitude=levels.decode(levels.encode(given.amplitude)), level_step_db=0.5)
    path = write_energyscapes(tmp_path / "img.h5", [rounded])
    with open_energyscapes(path) as images:
        assert (images.dtype, images[0].level_step_db) == ("float32", 0.5)
    with pytest.raises(ArgumentError, match=r"level_step_db of an energyscape is 0, but that of the first is 0\.5"):
        write_energyscapes(tmp_path / "other.h5", [rounded, given])


def test_8_bit_files_keep_the_step_of_coarser_levels(tmp_path):
    levels = LevelCodes(-122.0, 3.0)
    given = image()
    rounded = given.replace(amplitude=levels.decode(levels.encode(given.amplitude)), level_step_db=3.0)
    path = write_energyscapes(tmp_path / "img.h5", [rounded], dtype="uint8")
    with open_energyscapes(path) as images:
        assert images[0].level_step_db == 3.0
    with h5py.File(path, "r+") as file:
        file["sensors/sensor"].attrs["level_step_db"] = -1.0
    with pytest.raises(DamagedError, match="level_step_db is -1; use 0 to 10"):
        open_energyscapes(path)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("_FillValue", np.uint8(1), "is uint8 with _FillValue 1, wanted uint8 with 0"),
        ("_FillValue", None, "with _FillValue None"),
        ("scale_factor", None, "in steps of None dB"),
        ("scale_factor", np.float32(0), "in steps of 0.0 dB"),
        ("add_offset", np.float32(np.nan), "levels from nan dB"),
        ("add_offset", b"loud", "levels from loud dB"),
    ],
)
def test_unknown_scales_are_refused(tmp_path, name, value, match):
    path = write_energyscapes(tmp_path / "img.h5", [image()], dtype="uint8")
    with h5py.File(path, "r+") as file:
        attributes = file["sensors/sensor/level"].attrs
        del attributes[name]
        if value is not None:
            attributes[name] = value
    with pytest.raises(DamagedError, match=match):
        open_energyscapes(path)
