"""The ground truth of a simulated recording stays with it, and with its energyscapes."""

from dataclasses import asdict, replace

import h5py
import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Reflector, TrueSource
from ertis_numba.storage import (
    GroundTruth,
    GroundTruthLog,
    open_energyscapes,
    open_recording,
    write_energyscapes,
    write_recording,
)
from ertis_numba.storage.schema import TRUTH
from tests.files import image, noise, open_dataset

SENSOR = "eRTIS-7"
GROUP = f"sensors/{SENSOR}/truth"


def reflector(name="points[0]", **changes):
    given = {"azimuth_deg": -33.3, "elevation_deg": 12.1, "range_m": 1.7, "level_db": 0.0}
    return Reflector(name=name, **{**given, "velocity_m_s": (0.5, -0.25, 3.0), **changes})


ROWS = (
    (reflector(), reflector("wände[1] → wände[2] " * 5, range_m=2.5, level_db=-7.25)),
    (),
    (reflector(azimuth_deg=170.0),),
)


def truth(reflectors=ROWS, **changes):
    return GroundTruth(scene='name = "two"\n', seed=7, reflectors=reflectors, **changes)


def source(name="noises[0]", **changes):
    given = {"azimuth_deg": 45.0, "elevation_deg": -30.0, "range_m": 2.5, "position_m": (1.0, 2.0, -0.5)}
    return TrueSource(name=name, kind="noise", band_hz=(2e4, 8e4), **{**given, "level_dbfs": -61.5, **changes})


SOURCES = tuple((source(range_m=1.0 + row), source("noises[1]", level_dbfs=-300.0)) for row in range(3))


def same(one, other):
    """Angles are stored in radians, the unit of all angles in these files."""
    assert [[r.name for r in row] for row in one] == [[r.name for r in row] for row in other]
    for came, wanted in zip((r for row in one for r in row), (r for row in other for r in row), strict=True):
        for name, value in asdict(wanted).items():
            assert name == "name" or getattr(came, name) == pytest.approx(value, abs=1e-12)


@pytest.fixture
def path(tmp_path):
    return write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: truth()})


def images_of(recording):
    return [image().replace(stamp=measurement.stamp) for measurement in recording]


def test_truth_is_kept(path):
    with open_recording(path) as recording:
        assert (recording.truth.scene, recording.truth.seed) == (truth().scene, 7)
        same(recording.truth.reflectors, ROWS)


def test_sources_of_sound_are_kept(tmp_path):
    given = truth(sources=SOURCES)
    path = write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: given})
    with open_recording(path) as recording:
        assert [len(row) for row in recording.truth.sources] == [2, 2, 2]
        for came, wanted in zip(sum(recording.truth.sources, ()), sum(SOURCES, ()), strict=True):
            for name, value in asdict(wanted).items():
                assert getattr(came, name) == (value if isinstance(value, str) else pytest.approx(value, abs=1e-12))
        same(recording.truth.reflectors, ROWS)
        made = images_of(recording)
        write_energyscapes(tmp_path / "img.h5", [made[2], made[0]], recording=recording)
    with open_energyscapes(tmp_path / "img.h5") as images:
        assert [row[0].range_m for row in images.truth.sources] == [3.0, 1.0]
    with open_dataset(path, group=f"/{GROUP}", engine="netcdf4") as data:
        assert data["source_position"].dims == ("measurement", "source", "axis")
        assert data["source_band"].values.tolist() == [[2e4, 8e4]] * 2


def test_sources_without_reflectors_are_kept_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.storage.truth._BLOCK_ROWS", 2)
    with GroundTruthLog("", 5, folder=tmp_path) as log:
        for row in SOURCES:
            log.append((), row)
        path = write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: log})
    with open_recording(path) as recording:
        assert [row[0].range_m for row in recording.truth.sources] == [1.0, 2.0, 3.0]
        assert recording.truth.reflectors == ((), (), ())


def test_changed_sources_are_refused(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: truth(sources=SOURCES)})
    with h5py.File(path, "r+") as file:
        file[f"{GROUP}/source_level"][0, 0] = -10.0
    with pytest.raises(DataError, match="the content of sensor eRTIS-7 has SHA-256"):
        open_recording(path)


def test_other_sources_in_a_later_measurement_are_refused(tmp_path):
    with GroundTruthLog("", 5, folder=tmp_path) as log:
        log.append((), SOURCES[0])
        with pytest.raises(
            ArgumentError, match=r"measurement 1 has the sources \['noises\[0\]'\]; pass \['noises\[0\]',"
        ):
            log.append((), SOURCES[1][:1])


def test_recording_without_truth_has_none(tmp_path):
    write_recording(tmp_path / "rec.h5", noise())
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.truth is None


def test_measurements_without_reflectors_have_empty_truth(tmp_path):
    write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: truth(((), (), ()))})
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.truth.reflectors == ((), (), ())
    with open_dataset(tmp_path / "rec.h5", group=f"/{GROUP}", engine="netcdf4") as data:
        assert data["velocity"].shape == (3, 0, 3)


def test_xarray_shows_named_axes(path):
    with open_dataset(path, group=f"/{GROUP}", engine="netcdf4") as data:
        assert data["range"].dims == ("measurement", "target")
        assert data["velocity"].dims == ("measurement", "target", "axis")
        assert data["name"].values[0, 0] == "points[0]"
        assert data["azimuth"].attrs["units"] == "radian"
        assert np.isnan(data["level"].values).tolist() == [[False, False], [True, True], [False, True]]
        assert set(data.variables) == {variable.name for variable in TRUTH if not variable.optional}


@pytest.mark.parametrize("name", ["azimuth", "velocity", "name", "seed"])
def test_changed_truth_is_refused(path, name):
    with h5py.File(path, "r+") as file:
        group = file[GROUP]
        if name == "seed":
            group.attrs["seed"] = -8
        else:
            values = group[name][...]
            values[0, 0] = b"other" if name == "name" else np.nan
            group[name][...] = values
    with pytest.raises(DataError, match="the content of sensor eRTIS-7 has SHA-256"):
        open_recording(path)


def test_missing_truth_is_refused(path):
    with h5py.File(path, "r+") as file:
        del file[GROUP]
    with pytest.raises(DataError, match="the content of sensor eRTIS-7 has SHA-256"):
        open_recording(path)


def test_partial_truth_is_refused(path):
    with h5py.File(path, "r+") as file:
        del file[f"{GROUP}/level"]
    with pytest.raises(DataError, match=r"rec.h5 is damaged or cut short"):
        open_recording(path)


def test_energyscapes_keep_the_truth(path, tmp_path):
    with open_recording(path) as recording:
        write_energyscapes(tmp_path / "img.h5", images_of(recording), recording=recording)
    with open_energyscapes(tmp_path / "img.h5") as images:
        assert images.truth.scene == truth().scene
        same(images.truth.reflectors, ROWS)


def test_each_energyscape_keeps_the_truth_of_its_measurement(path, tmp_path):
    with open_recording(path) as recording:
        made = images_of(recording)
        write_energyscapes(tmp_path / "img.h5", [made[2], made[0]], recording=recording)
    with open_energyscapes(tmp_path / "img.h5") as images:
        same(images.truth.reflectors, (ROWS[2], ROWS[0]))


def test_energyscapes_accept_a_given_truth(path, tmp_path):
    with open_recording(path) as recording:
        made = images_of(recording)
        given = {SENSOR: truth((ROWS[1], ROWS[1], ROWS[2]))}
        write_energyscapes(tmp_path / "img.h5", made, recording=recording, truth=given)
    with open_energyscapes(tmp_path / "img.h5") as images:
        same(images.truth.reflectors, (ROWS[1], ROWS[1], ROWS[2]))


def test_truth_of_another_recording_is_refused(path, tmp_path):
    with open_recording(path) as recording:
        made = images_of(recording)
        strange = made[1].replace(stamp=replace(made[1].stamp, sequence=99))
        with pytest.raises(
            ArgumentError, match="energyscape 1 of sensor eRTIS-7 has the stamp of 0 measurements of the recording"
        ):
            write_energyscapes(tmp_path / "img.h5", [made[0], strange], recording=recording)
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_truth_of_another_length_is_refused(tmp_path):
    with pytest.raises(
        ArgumentError,
        match="the truth of sensor eRTIS-7 has 2 measurements, but the file has 3; pass the reflectors of each",
    ):
        write_recording(tmp_path / "rec.h5", noise(), truth={SENSOR: truth(ROWS[:2])})
    assert not list(tmp_path.iterdir())


def test_truth_of_an_absent_sensor_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"truth is given for sensor 'left', which has no measurement; .* eRTIS-7"):
        write_recording(tmp_path / "rec.h5", noise(), truth={"left": truth()})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "seed is -1; use a whole number from 0 to 9223372036854775807"),
        ({"reflectors": ((reflector(range_m=np.nan),),)}, r"range_m of the true reflectors holds nan at \[0\]; pass"),
        (
            {"reflectors": ((reflector(), reflector(level_db=-np.inf)),)},
            r"level_db of the true reflectors holds -inf at \[1\]; pass finite numbers",
        ),
        ({"sources": SOURCES}, "the truth has sources of 3 measurements, but reflectors of 0; pass both for each"),
    ],
)
def test_invalid_truth_is_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        GroundTruth(**{"scene": "", "seed": 1, "reflectors": (), **changes})
