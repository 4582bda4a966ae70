"""Recordings of one array read as another: other layouts, orders, units, converters out of step, other calls."""

import dataclasses
import functools

import numpy as np
import pytest

from ertis_numba.analysis.call_match import call_match
from ertis_numba.analysis.health import health
from ertis_numba.analysis.layout_match import layout_match
from ertis_numba.geometry import layout_names, load_layout
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import Array, Call, Recording
from ertis_numba.simulation import Electronics, Point
from ertis_numba.storage import write_recording
from tests.health_recordings import rendered
from tests.scenes import SENSOR

SIDE = Point(azimuth_deg=35, elevation_deg=15, range_m=0.9, strength_db=-5)
AHEAD = Point(azimuth_deg=4, elevation_deg=-3, range_m=1.1, strength_db=-5)
FAULTS = {"order of channels", "size of the array", "half late", "shifted record"}


@functools.cache
def recorded(layout, point, noise_dbfs=-60.0):
    sensor = SENSOR.replace(
        array=Array(layout=layout),
        recording=Recording(n_samples=65_536),
        electronics=Electronics(noise_dbfs=noise_dbfs),
    )
    return rendered(sensor, point)


@functools.cache
def spiral(size_m):
    """An echo received by 16 microphones on a spiral, as PCM."""
    turn = 2.4 * np.arange(16)
    radius_m = size_m / 2 * np.sqrt((np.arange(16) + 1) / 16)
    places_m = np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)
    sensor = SENSOR.replace(
        array=Array(positions_m=places_m),
        recording=Recording(n_samples=4800, sample_rate_hz=300e3, encoding="int16"),
        electronics=Electronics(noise_dbfs=-70.0),
    )
    return rendered(sensor, SIDE)


def read_as(measurement, **array):
    settings = measurement.settings
    return dataclasses.replace(measurement, settings=settings.replace(array=settings.array.replace(**array)))


def faults(measurement):
    return [finding.fault for finding in health(measurement).findings if finding.fault in FAULTS]


@pytest.mark.parametrize("point", [SIDE, AHEAD], ids=["side", "ahead"])
@pytest.mark.parametrize("read", layout_names())
def test_another_layout_is_found(read, point):
    layout = "eRTIS_v3D1" if point is SIDE else "uRTIS_v1"
    given = recorded(layout, point)
    found = layout_match(dataclasses.replace(given, settings=given.settings.replace(array=Array(layout=read))))
    assert (found.finding and found.finding.fault) == (None if read == layout else "order of channels")


@pytest.mark.parametrize("size_m", [0.02, 0.06])
@pytest.mark.parametrize("factor", [10, 2.54])
def test_positions_in_a_larger_unit_are_found(size_m, factor):
    given = spiral(size_m)
    assert not faults(given)
    places_m = factor * np.asarray(given.settings.array.positions_m)
    assert faults(read_as(given, positions_m=places_m)) == ["size of the array"]


@pytest.mark.parametrize("factor", [1 / 2.54, 0.1])
def test_positions_in_a_smaller_unit_are_found(factor):
    given = spiral(0.06)
    assert faults(read_as(given, positions_m=factor * np.asarray(given.settings.array.positions_m))) == [
        "size of the array"
    ]


def test_reversed_channels_and_a_late_converter_are_found():
    given = spiral(0.02)
    assert faults(read_as(given, positions_m=given.settings.array.positions_m[::-1])) == ["order of channels"]
    words = recorded("uRTIS_v1", SIDE)
    late = words.data.copy()
    upper = np.uint32(0xFFFF0000)
    late[9:] = (words.data[9:] & ~upper) | (words.data[:-9] & upper)  # 2 µs
    (finding,) = health(dataclasses.replace(words, data=late)).record_faults
    assert (finding.fault, finding.detail) == ("half late", "channels 16 to 31 are late by 2.0 µs")


@pytest.mark.parametrize("layout", layout_names())
@pytest.mark.parametrize("seed", range(2))
def test_right_layout_is_never_accused(layout, seed):
    """Echoes overlap, noise rises, and the microphones have the delays that arrays have."""
    rng = np.random.default_rng([seed, *layout.encode()])
    points = [
        Point(
            azimuth_deg=rng.uniform(-70, 70),
            elevation_deg=rng.uniform(-40, 40),
            range_m=rng.choice([rng.uniform(0.4, 1.6), 0.8 + rng.uniform(0, 0.03)]),
            strength_db=rng.uniform(-20, 0),
        )
        for _ in range(rng.integers(1, 6))
    ]
    sensor = SENSOR.replace(
        array=Array(layout=layout),
        recording=Recording(n_samples=65_536),
        electronics=Electronics(noise_dbfs=rng.choice([-60.0, -30.0, -12.0])),
    )
    given = rendered(sensor, *points)
    assert not faults(given)
    delay_s = rng.normal(0, 3e-6, len(load_layout(layout).enabled))
    array = load_layout(layout).to_array().replace(delay_s=delay_s)
    shifted = dataclasses.replace(given, settings=given.settings.replace(array=array))
    assert not layout_match(shifted).warning


def test_check_of_a_wrong_layout_is_a_fault(tmp_path):
    path = write_recording(tmp_path / "a.h5", [recorded("eRTIS_v3D1", SIDE)])
    checked = check_recording(path, settings=lambda own: own.replace(array=Array(layout="eRTIS_v2")))
    assert not checked.is_fit
    assert "channels are not in the order of the layout (layout eRTIS_v3D1 fits far better" in checked.verdict


@pytest.mark.parametrize("band_hz", [(50e3, 25e3), (80e3, 20e3)])
@pytest.mark.parametrize("emitted", ["linear", "hyperbolic"])
@pytest.mark.parametrize("noise_dbfs", [-15.0])
def test_sweep_of_another_modulation_is_named(band_hz, emitted, noise_dbfs):
    call = Call(modulation=emitted, start_frequency_hz=band_hz[0], stop_frequency_hz=band_hz[1])
    sensor = SENSOR.replace(
        call=call, recording=Recording(n_samples=65_536), electronics=Electronics(noise_dbfs=noise_dbfs)
    )
    given = rendered(sensor, SIDE, AHEAD)
    for read in ("linear", "hyperbolic"):
        match = call_match(dataclasses.replace(given, settings=given.settings.replace("call.modulation", read)))
        assert (match.verdict == "matches") == (read == emitted)
        assert match.verdict == "matches" or match.sweep.modulation == emitted
        assert match.verdict == "matches" or match.sweep.start_hz == pytest.approx(band_hz[0], rel=0.15)
