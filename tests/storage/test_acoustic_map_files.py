"""Files of acoustic maps return what was written, and are refused if they are damaged."""

import dataclasses
import os
import re

import h5py
import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, FormatVersionError
from ertis_numba.settings import Array, Settings
from ertis_numba.storage import file_kind, recorded_trajectory, sensor_names
from tests.files import image, noise, open_dataset

GROUP = "sensors/eRTIS-7"


def acoustic_map(seed=1, sensor="eRTIS-7", **changes):
    random = np.random.default_rng(seed)
    made = ertis.AcousticMap(
        power=random.exponential(1e-6, (5, 3)).astype(np.float32),
        azimuth_rad=np.linspace(-1.0, 1.0, 5),
        elevation_rad=np.linspace(0.0, 0.2, 5),
        band_hz=np.array([[20e3, 25e3], [25e3, 31.5e3], [31.5e3, 40e3]]),
        settings=Settings(),
        stamp=ertis.Stamp(
            sensor=sensor, sequence=seed, timestamp_ns=1_700_000_000_000_000_123, behaviour="passive", session_id=5
        ),
        n_measurements=seed,
        n_blocks=40 * seed,
        masked_s=0.0035 * (seed % 2),
    )
    return made.replace(**changes)


@pytest.fixture
def path(tmp_path):
    return ertis.write_acoustic_maps(tmp_path / "maps.h5", [acoustic_map(seed) for seed in (1, 2, 3)])


def test_maps_are_read_as_written(path):
    with ertis.open_acoustic_maps(path) as reader:
        assert len(reader) == 3
        assert reader.settings == Settings().replace(array=reader.settings.array)
        for found, wanted in zip(reader, map(acoustic_map, (1, 2, 3)), strict=True):
            assert found.power.dtype == np.float32
            for name in ("power", "azimuth_rad", "elevation_rad", "band_hz"):
                assert np.array_equal(getattr(found, name), getattr(wanted, name))
            for name in ("stamp", "n_measurements", "n_blocks", "masked_s"):
                assert getattr(found, name) == getattr(wanted, name)
        assert reader.azimuth_deg == pytest.approx(np.degrees(acoustic_map().azimuth_rad))
        assert [stamp.sequence for stamp in reader.stamps()] == [1, 2, 3]
    assert file_kind(path) == "acoustic_map"


def test_maps_of_several_sensors_share_a_file(tmp_path):
    maps = [acoustic_map(1, "left"), acoustic_map(2, "right"), acoustic_map(3, "left")]
    mounting = {"left": ((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))}
    path = ertis.write_acoustic_maps(tmp_path / "maps.h5", maps, mounting=mounting)
    assert sensor_names(path) == ("left", "right")
    with ertis.open_acoustic_maps(path, sensor="left") as left, ertis.open_acoustic_maps(path, sensor="right") as right:
        assert [len(left), len(right)] == [2, 1]
        assert left.translation_m.tolist() == [0.1, 0.2, 0.3]
        assert right.translation_m is None
    with pytest.raises(ArgumentError, match="contains 2 sensors; choose one of left, right"):
        ertis.open_acoustic_maps(path)


def test_map_file_names_its_recording(tmp_path):
    source = ertis.write_recording(
        tmp_path / "rec.h5", noise(count=1), mounting={"eRTIS-7": ((0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    )
    with ertis.open_recording(source) as recording:
        path = ertis.write_acoustic_maps(tmp_path / "maps.h5", [acoustic_map()], recording=recording)
        uuid = recording.uuid
        with pytest.raises(ArgumentError, match=r"rec\.h5"):
            ertis.write_acoustic_maps(source, [acoustic_map()], recording=recording, overwrite=True)
    with ertis.open_acoustic_maps(path) as reader:
        assert reader.attributes["recording_uuid"] == uuid
        assert reader.translation_m.tolist() == [0.5, 0.0, 0.0]


def test_poses_are_those_at_the_last_measurements(tmp_path):
    heard = noise(count=4)
    drive = ertis.Trajectory(
        [heard[0].stamp.timestamp_ns, heard[-1].stamp.timestamp_ns],
        [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]],
        [[0.0, 0.0, 0.0, 1.0]] * 2,
        source="file",
    )
    source = ertis.write_recording(tmp_path / "rec.h5", heard, poses=drive)
    maps = [acoustic_map(stamp=heard[index].stamp) for index in (1, 3)]
    with ertis.open_recording(source) as recording:
        path = ertis.write_acoustic_maps(tmp_path / "maps.h5", maps, recording=recording)
    with ertis.open_acoustic_maps(path) as reader:
        assert reader.trajectory.time_ns.tolist() == [each.stamp.timestamp_ns for each in maps]
        assert reader.trajectory.position_m[:, 0].tolist() == pytest.approx([1.0, 3.0])
        assert reader.trajectory.source == "file"
        assert recorded_trajectory(path).position_m.tolist() == reader.trajectory.position_m.tolist()
    with h5py.File(path, "r+") as file:
        file[f"{GROUP}/pose_position"][1, 0] = 2.0
    with pytest.raises(DamagedError, match="has SHA-256"):
        ertis.open_acoustic_maps(path)


def test_identity_depends_on_content_only(tmp_path):
    uuids = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        with ertis.open_acoustic_maps(ertis.write_acoustic_maps(tmp_path / name, [acoustic_map(seed)])) as reader:
            uuids.append(reader.uuid)
    assert uuids[0] == uuids[1] != uuids[2]


def test_maps_need_no_other_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some.csv").write_text("0,0\n10,0\n")
    settings = Settings().replace("processing.directions", "some.csv")
    path = ertis.write_acoustic_maps("maps.h5", [acoustic_map(settings=settings)])
    (tmp_path / "some.csv").unlink()
    with ertis.open_acoustic_maps(path) as reader:
        assert len(reader[0].settings.array.positions_m) == 32


def test_xarray_shows_the_axes(path):
    with open_dataset(path, group=f"/{GROUP}", engine="h5netcdf") as found:
        assert found.power.dims == ("time", "direction", "band")
        assert found.band_edge.dims == ("band", "edge")
        assert found.n_measurements.values.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"settings": Settings(array=Array(layout="eRTIS_v3D1")).replace("passive.averages", 2)}, "settings of an"),
        ({"azimuth_rad": np.linspace(-1.0, 1.1, 5)}, "azimuth_rad of an acoustic map differs"),
        ({"band_hz": np.array([[20e3, 25e3], [25e3, 30e3], [30e3, 40e3]])}, "band_hz of an acoustic map differs"),
    ],
)
def test_map_unlike_the_first_is_refused(tmp_path, changes, message):
    with pytest.raises(ArgumentError, match=message):
        ertis.write_acoustic_maps(tmp_path / "maps.h5", [acoustic_map(1), acoustic_map(2, **changes)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: ertis.write_acoustic_maps(path, []), "would contain no measurement"),
        (lambda path: ertis.write_acoustic_maps(path, [image()]), "maps"),
        (lambda path: ertis.write_acoustic_maps(path, acoustic_map()), "maps"),
        (
            lambda path: ertis.write_acoustic_maps(
                path, [acoustic_map()], mounting={"left": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
            ),
            "mounting is given for sensor 'left'",
        ),
    ],
)
def test_maps_that_cannot_be_written_leave_no_file(tmp_path, call, message):
    with pytest.raises(ArgumentError, match=message):
        call(tmp_path / "maps.h5")
    assert not list(tmp_path.iterdir())


def test_existing_file_is_kept(path):
    before = path.read_bytes()
    with pytest.raises(ArgumentError, match="exists"):
        ertis.write_acoustic_maps(path, [acoustic_map()])
    assert path.read_bytes() == before


@pytest.mark.parametrize("kept", [0.0001, 0.3, 0.9999])
def test_truncated_map_file_is_reported(path, kept):
    os.truncate(path, int(kept * path.stat().st_size))
    with pytest.raises(DataError, match=r"is cut short or damaged: it has \d+( of \d+)? bytes|is not an HDF5 file"):
        ertis.open_acoustic_maps(path)


def spoil_count(file):
    file[f"{GROUP}/n_blocks"][1] = 7


def spoil_band(file):
    file[f"{GROUP}/band_edge"][0, 0] = 1.0


def drop_bands(file):
    del file[f"{GROUP}/band_edge"]


def spoil_version(file):
    file.attrs["ertis_format_version"] = 5


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (spoil_count, DamagedError, "has SHA-256"),
        (spoil_band, DamagedError, "has SHA-256"),
        (drop_bands, DamagedError, "has no 'band_edge' for sensor eRTIS-7; copy it again"),
        (spoil_version, FormatVersionError, "has format version 5"),
    ],
)
def test_spoiled_map_file_is_refused(path, spoil, error, message):
    with h5py.File(path, "r+") as file:
        spoil(file)
    with pytest.raises(error, match=rf"{re.escape(str(path))}.*{message}"):
        ertis.open_acoustic_maps(path)


def test_map_outside_the_file_is_refused(path):
    with ertis.open_acoustic_maps(path) as reader, pytest.raises(IndexError, match="has no acoustic map 3; it has 3"):
        reader[3]


def test_missing_map_file_is_reported(tmp_path):
    with pytest.raises(DataError, match="No such file or directory; choose a file of acoustic maps"):
        ertis.open_acoustic_maps(tmp_path / "maps.h5")


def test_flipped_bit_in_the_powers_is_found(path):
    with h5py.File(path, "r+") as file:
        file[f"{GROUP}/power"][1, 2, 1] *= 1.5
    with ertis.open_acoustic_maps(path) as reader:
        assert reader[0].n_measurements == 1
        with pytest.raises(DamagedError, match="acoustic map 1 has CRC-32"):
            reader[1]


def test_impossible_counts_are_damage(tmp_path, monkeypatch):
    monkeypatch.setattr(ertis.AcousticMap, "__post_init__", lambda _: None)
    wrong = dataclasses.replace(acoustic_map(), n_measurements=0)
    path = ertis.write_acoustic_maps(tmp_path / "maps.h5", [wrong])
    monkeypatch.undo()
    with (
        ertis.open_acoustic_maps(path) as reader,
        pytest.raises(DamagedError, match="acoustic map 0: n_measurements is 0"),
    ):
        reader[0]


def test_files_of_other_kinds_are_refused(path, tmp_path):
    ertis.write_energyscapes(tmp_path / "img.h5", [image()])
    ertis.write_recording(tmp_path / "rec.h5", noise(count=1))
    with pytest.raises(DataError, match=r"rec\.h5 is a recording, wanted a file of acoustic maps; process it first"):
        ertis.open_acoustic_maps(tmp_path / "rec.h5")
    with pytest.raises(DataError, match=r"img\.h5 is an energyscape file, wanted a file of acoustic maps; proce"):
        ertis.open_acoustic_maps(tmp_path / "img.h5")
    with pytest.raises(DataError, match=r"maps\.h5 is a file of acoustic maps, wanted an energyscape file; proces"):
        ertis.open_energyscapes(path)
    with pytest.raises(DataError, match=r"maps\.h5 is a file of acoustic maps, wanted a recording; use the recording"):
        ertis.open_recording(path)
