"""Conversions to xarray and structured arrays, levels, selections and angles of frames."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.geometry import direction_grid
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop._points import PointTable
from ertis_numba.settings import Processing
from ertis_numba.storage import open_energyscapes, write_energyscapes, write_recording
from ertis_numba.storage.schema import ENERGYSCAPE
from tests.cases import CASES, noise as one_noise
from tests.files import image, line, noise, open_dataset

SOLID = direction_grid(Processing(directions="3d:60"))


def solid():
    return image(np.degrees(SOLID.azimuth_rad), np.degrees(SOLID.elevation_rad))


# ---- xarray ------------------------------------------------------------------------------------------


def joined_over_time(frames):
    """Join arrays of frames as xarray users do."""
    import xarray  # noqa: PLC0415 - it imports pandas, which few tests need

    return xarray.concat([each.to_xarray() for each in frames], "time")


def test_energyscapes_have_the_names_and_values_of_their_files(tmp_path):
    images = [image(), image(seed=2)]
    path = write_energyscapes(tmp_path / "img.h5", images)
    joined = joined_over_time(images)
    with open_dataset(path, group="/sensors/sensor", engine="h5netcdf") as data:
        stored = data["amplitude"]
        assert joined.name == stored.name
        assert joined.dims == stored.dims
        assert {*joined.coords} == {*stored.coords}
        assert np.array_equal(joined.values, stored.values)
        for name in stored.coords:
            assert joined[name].dims == stored[name].dims
            assert np.array_equal(joined[name].values, stored[name].values)
            assert joined[name].attrs.get("units") == stored[name].attrs.get("units")
        assert joined.attrs["settings"] == image().settings.to_toml()
    about = {variable.name for variable in ENERGYSCAPE}
    assert {*joined.coords, joined.name} <= about


def test_arrays_of_rounded_levels_state_the_step():
    assert "level_step_db" not in image().to_xarray().attrs
    assert image().replace(level_step_db=0.5).to_xarray().attrs["level_step_db"] == 0.5


def test_energyscapes_share_memory_with_xarray_and_select_by_label():
    given = image()
    data = given.to_xarray()
    assert np.shares_memory(data.values, given.amplitude)
    assert float(data.max("direction").idxmax("range")) == given.range_m[200]
    near = data.sel(range=slice(0.5, 1.0))
    assert np.array_equal(near.values, given.select(range_m=(0.5, 1.0)).amplitude)


@pytest.mark.parametrize("settings", [line(8, 8), line(70, 16)], ids=["one word", "five words"])
def test_measurements_have_the_names_and_values_of_their_files(tmp_path, settings):
    given = noise(settings)
    path = write_recording(tmp_path / "rec.h5", given)
    joined = joined_over_time(given)
    with open_dataset(path, group="/sensors/eRTIS-7", engine="h5netcdf") as data:
        assert joined.dims == data["pdm"].dims
        assert np.array_equal(joined.values, data["pdm"].values)
        assert np.array_equal(joined["time"].values, data["time"].values)
        for each, sequence, sync_count in zip(given, data["sequence"], data["sync_count"], strict=True):
            attributes = each.to_xarray().attrs
            assert (attributes["sequence"], attributes["sync_count"]) == (int(sequence), int(sync_count))
            assert (attributes["sensor"], attributes["session_id"]) == ("eRTIS-7", 0)


def test_pcm_measurements_have_a_microphone_axis():
    measurement = one_noise(CASES["PCM, calibrated"])
    data = measurement.to_xarray()
    assert (data.name, data.dims) == ("pcm", ("sample", "microphone"))
    assert data["microphone"].values.tolist() == list(range(8))
    assert np.array_equal(data.sel(microphone=3).values, measurement.data[:, 3])


# ---- structured arrays -------------------------------------------------------------------------------


def cloud():
    random = np.random.default_rng(4)
    return ertis.PointCloud(
        random.standard_normal((9, 3)).astype(np.float32),
        random.random(9, dtype=np.float32),
        image().settings,
        ertis.Stamp(sequence=4, session_id=2, sync_count=7, timestamp_ns=1_700_000_000_000_000_001),
        uncertainty_m=random.random((9, 2), dtype=np.float32),
    )


def test_point_clouds_become_the_rows_of_exported_files():
    found = cloud()
    rows = found.to_structured()
    exported = PointTable.from_images([image()], lambda _: found, {}).rows
    assert set(rows.dtype.names) == set(exported.dtype.names) - {"sensor"}
    for name in rows.dtype.names:
        # Exported positions may be those of a platform far from the origin, which float32 does not resolve.
        assert exported.dtype[name] == (np.float64 if name in {"x", "y", "z"} else rows.dtype[name])
        assert np.array_equal(rows[name], exported[name], equal_nan=True)


def test_points_without_uncertainty_have_nan():
    rows = cloud().replace(uncertainty_m=None).to_structured()
    assert np.isnan(rows["uncertainty_range"]).all()
    assert (
        len(cloud().replace(position_m=np.zeros((0, 3)), amplitude=np.zeros(0), uncertainty_m=None).to_structured())
        == 0
    )


# ---- levels and arithmetic ---------------------------------------------------------------------------


def test_levels_are_relative_to_the_strongest_and_to_full_scale():
    given = image()
    given.amplitude[0, 0] = 0
    assert given.level_db.max() == 0
    assert given.level_dbfs.max() == pytest.approx(20 * math.log10(0.5))
    assert given.level_db[0, 0] == given.level_dbfs[0, 0] == -math.inf
    assert given.level_db.dtype == np.float32
    assert np.allclose((given.level_dbfs[1:] - given.level_db[1:]), 20 * math.log10(0.5), atol=1e-4)
    assert np.all(given.replace(amplitude=np.zeros_like(given.amplitude)).level_db == -math.inf)


def test_arithmetic_is_that_of_numpy():
    difference = np.subtract(image(), image(seed=2))
    assert np.array_equal(difference, image().amplitude - image(seed=2).amplitude)
    assert np.array_equal(np.mean([image(), image(seed=2)], axis=0), (image().amplitude + image(seed=2).amplitude) / 2)


# ---- selection ---------------------------------------------------------------------------------------


def test_selection_keeps_what_lies_within_the_limits():
    given = solid()
    part = given.select(azimuth_deg=(-30, 20), elevation_deg=(-5, 45), range_m=(1, math.inf))
    inside = (
        (given.azimuth_deg >= -30)
        & (given.azimuth_deg <= 20)
        & (given.elevation_deg >= -5)
        & (given.elevation_deg <= 45)
    )
    assert 0 < inside.sum() < len(inside)
    assert np.array_equal(part.amplitude, given.amplitude[inside][:, given.range_m >= 1])
    assert np.array_equal(part.azimuth_rad, given.azimuth_rad[inside])
    assert np.array_equal(part.range_m, given.range_m[given.range_m >= 1])
    assert part.settings == given.settings
    assert np.array_equal(given.select().amplitude, given.amplitude)


def test_limits_of_a_selection_are_included():
    part = image().select(azimuth_deg=(-45, 45), range_m=(0.5, 5.0))
    assert part.azimuth_deg[[0, -1]].tolist() == pytest.approx([-45, 45])
    assert len(part.range_m) == 400
    assert len(image().select(azimuth_deg=(10, 10)).azimuth_rad) == 1


def test_azimuth_limits_are_circular():
    given = image(azimuth_deg=np.arange(-180, 180, 10))
    assert given.select(azimuth_deg=(170, 190)).azimuth_deg.tolist() == pytest.approx([-180, -170, 170])
    assert len(given.select(azimuth_deg=(-180, 180)).azimuth_rad) == 36


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"azimuth_deg": (100, 110)}, r"no direction lies within azimuth_deg \(100, 110\).* azimuths from -90 to 90"),
        ({"elevation_deg": (1, 2)}, "no direction lies within .* elevations from 0 to 0 degrees"),
        ({"range_m": (6, 7)}, r"no range lies within range_m \(6, 7\); the image has ranges from 0.5 to 5 m"),
        ({"range_m": (2, 1)}, "range_m runs from 2 to 1; use two numbers, the smaller one first"),
        ({"range_m": (math.nan, 1)}, "range_m runs from nan to 1"),
        ({"range_m": 3}, "range_m is 3; use a pair of numbers"),
        ({"azimuth_deg": ("a", "b")}, "azimuth_deg is .* use a pair of numbers"),
    ],
)
def test_unusable_limits_are_refused_in_one_line(limits, message):
    with pytest.raises(ertis.ArgumentError, match=message) as caught:
        image().select(**limits)
    assert "\n" not in str(caught.value)


# ---- angles ------------------------------------------------------------------------------------------


def pairs(tmp_path):
    write_energyscapes(tmp_path / "img.h5", [solid()])
    yield from (solid(), SOLID, cloud())
    with open_energyscapes(tmp_path / "img.h5") as reader:
        yield reader
    yield ertis.Peak(azimuth_deg=10.0, elevation_deg=-20.0, range_m=1.0, level_db=0.0)
    yield ertis.Reflector(name="a", azimuth_deg=10.0, elevation_deg=-20.0, range_m=1.0, level_db=0.0)


def test_angles_are_given_in_degrees_and_radians(tmp_path):
    count = 0
    for given in pairs(tmp_path):
        for name in ("azimuth", "elevation"):
            degrees = np.asarray(getattr(given, f"{name}_deg"))
            assert np.allclose(np.radians(degrees), getattr(given, f"{name}_rad"), rtol=0, atol=1e-15)
            count += 1
    assert count == 12
    processing = Processing(azimuth_limits_deg=(-45, 90), elevation_limits_deg=(0, 30))
    assert processing.azimuth_limits_rad == pytest.approx((-math.pi / 4, math.pi / 2))
    assert processing.elevation_limits_rad == pytest.approx((0, math.pi / 6))


def test_points_have_the_direction_and_range_of_their_position():
    found = cloud()
    away = np.stack(
        [
            np.cos(found.elevation_rad) * np.cos(found.azimuth_rad),
            np.cos(found.elevation_rad) * np.sin(found.azimuth_rad),
            np.sin(found.elevation_rad),
        ],
        axis=1,
    )
    assert np.allclose(found.range_m[:, None] * away, found.position_m, atol=1e-6)


def test_signals_have_the_range_of_an_echo():
    settings = CASES["default"]
    with ertis.Pipeline(settings, "cpu", 1, predict=False) as pipeline:
        found = pipeline.signals(one_noise(settings))
    assert found.range_m == pytest.approx(found.time_s * sound_speed_m_s(settings.air) / 2)
