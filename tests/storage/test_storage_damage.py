"""Damaged files are refused in one line, and a full disk leaves no file."""

import os
import resource
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest

from ertis_numba.base import atomic_files
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, FormatVersionError
from ertis_numba.frames import Reflector
from ertis_numba.settings import Recording
from ertis_numba.storage import (
    GroundTruth,
    file_kind,
    open_energyscapes,
    open_recording,
    write_energyscapes,
    write_recording,
)
from ertis_numba.storage.verify import verify
from tests.files import image, line, noise

GROUP = "sensors/eRTIS-7"


@pytest.fixture
def path(tmp_path):
    return write_recording(tmp_path / "rec.h5", noise())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file or directory; choose a recording$"),
        (b"", "is empty; choose a recording"),
        (b"abc" * 1000, "is not an HDF5 file; choose a recording"),
    ],
)
def test_text_file_is_not_a_recording(tmp_path, content, message):
    path = tmp_path / "file.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        open_recording(path)


def test_impossible_gap_is_damage(path):
    with h5py.File(path, "a") as file:
        for name, value in {"": 0.0, "_first": 3, "_last": 2, "_reason": b"footer", "_session_id": 0}.items():
            column = file[f"{GROUP}/gap{name}"]
            column.resize((1,))
            column[0] = value
    with pytest.raises(DamagedError, match=r"a gap of sensor eRTIS-7 is damaged .*is 2\); copy it again"):
        open_recording(path)


def test_folder_is_not_a_recording(tmp_path):
    with pytest.raises(DataError, match="is a folder; choose"):
        open_recording(tmp_path)


def test_foreign_hdf5_file_is_refused(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    for read in (open_recording, open_energyscapes, file_kind):
        with pytest.raises(DataError, match="is HDF5, but not of this package; choose a"):
            read(tmp_path / "other.h5")


def test_energyscape_file_is_not_a_recording(path, tmp_path):
    write_energyscapes(tmp_path / "img.h5", [image()])
    with pytest.raises(DataError, match=r"rec.h5 is a recording, wanted an energyscape file; process it first"):
        open_energyscapes(path)
    with pytest.raises(DataError, match=r"img.h5 is an energyscape file, wanted a recording; use the recording"):
        open_recording(tmp_path / "img.h5")


@pytest.mark.parametrize("kept", [0.0001, 0.01, 0.3, 0.9, 0.9999])
def test_truncated_file_is_reported(path, kept):
    os.truncate(path, int(kept * path.stat().st_size))
    with pytest.raises(DataError, match=r"is cut short or damaged: it has \d+ of \d+ bytes|is not an HDF5 file"):
        open_recording(path)


HOLDING = """
import h5py, sys
with h5py.File(sys.argv[1], "r+"):
    print("open", flush=True)
    sys.stdin.read()
"""


def held_open(path, **more):
    """Start a process, and wait until it has opened a file for writing."""
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | more,
        text=True,
    )
    assert holder.stdout.readline() == "open\n"
    return holder


def test_file_open_for_writing_is_not_reported_as_damaged(path):
    with held_open(path) as holder:
        for read in (open_recording, file_kind):
            with pytest.raises(DataError, match=r"rec.h5 is open for writing in another program; close it there"):
                read(path)
        holder.stdin.close()
    with open_recording(path) as recording:
        assert len(recording) == 3


def test_file_of_a_killed_writer_is_not_reported_as_damaged(path):
    with held_open(path) as holder:
        holder.kill()
    with pytest.raises(
        DataError,
        match=r"rec.h5 was not closed: its writer was killed, or .* run 'h5clear -s /.*/rec.h5' \(part of",
    ):
        open_recording(path)


def add_empty(owner):
    for name in ("TITLE", "a text", "numbers"):
        owner.attrs[name] = h5py.Empty("f8" if name == "numbers" else "S1")


def add_foreign_types(owner):
    space = h5py.h5s.create(h5py.h5s.SCALAR)
    h5py.h5a.create(owner.id, b"a bit field", h5py.h5t.STD_B8LE, space)
    h5py.h5a.create(owner.id, b"a time", h5py.h5t.UNIX_D32LE, space)


@pytest.mark.parametrize("add", [add_empty, add_foreign_types])
def test_attributes_of_other_programs_are_no_damage(path, add):
    with h5py.File(path, "r+") as file:
        add(file)
        file.visititems(lambda _, item: add(item))
    with open_recording(path) as recording:
        assert len(recording[:]) == 3
        assert recording.attributes.get("TITLE", "") == ""
        assert recording.attributes.get("numbers") is None
    assert file_kind(path) == "recording"
    assert all(report.is_intact for report in verify(path))


@pytest.mark.parametrize(
    ("version", "problem"), [(5, "this package reads up to 4; update"), (1, "this package reads 2 to 4; make the file")]
)
def test_unknown_format_version_is_refused(version, problem, path):
    with h5py.File(path, "r+") as file:
        file.attrs["ertis_format_version"] = version
    with pytest.raises(FormatVersionError, match=f"has format version {version}, but {problem}"):
        open_recording(path)


def test_flipped_bit_in_the_samples_is_found(path):
    with h5py.File(path, "r+") as file:
        file[f"{GROUP}/pdm"][1, 777] ^= 1 << 9
    with open_recording(path) as recording:
        assert recording[0].stamp.sequence == 10
        with pytest.raises(DataError, match=r"rec.h5: measurement 1 has CRC-32 .* the file is damaged; copy it again"):
            recording[1]


def test_array_variables_that_contradict_the_settings_are_damage(path):
    for name, place, message in [
        ("calibration_gain", (3,), "calibration_gain of channel 3 is nan, but the settings in the file give 1"),
        ("calibration_delay", (0,), "calibration_delay of channel 0 is nan"),
        ("microphone_position", (31, 1), "microphone_position of channel 31 is nan"),
    ]:
        with h5py.File(path, "r+") as file:
            values = file[f"{GROUP}/{name}"]
            before, values[place] = values[place], np.nan
        with pytest.raises(DataError, match=message):
            open_recording(path)
        with h5py.File(path, "r+") as file:
            file[f"{GROUP}/{name}"][place] = before
    open_recording(path).close()


def test_unusable_settings_are_damage(path):
    with h5py.File(path, "r+") as file:
        text = file[f"{GROUP}/settings"]
        text[()] = text[()].replace(b"duration_s = 0.0025", b"duration_s = nan")
    with pytest.raises(DataError, match=r"rec.h5: settings, call: call.duration_s is nan; use a finite number"):
        open_recording(path)


def test_missing_variable_is_damage(path):
    with h5py.File(path, "r+") as file:
        del file[f"{GROUP}/crc32"]
    with pytest.raises(DataError, match="has no 'crc32' for sensor eRTIS-7; copy it again"):
        open_recording(path)


def test_variables_of_unequal_lengths_are_damage(path):
    with h5py.File(path, "r+") as file:
        file[f"{GROUP}/sequence"].resize((2,))
    with pytest.raises(DataError, match=r"sequence has shape \(2,\), wanted \(3,\); copy it again"):
        open_recording(path)


def test_unknown_measurement_is_refused(path):
    with open_recording(path) as recording:
        with pytest.raises(IndexError, match="has no measurement 3; it has 3, counted from 0"):
            recording[3]
        with pytest.raises(IndexError, match="has no measurement -4"):
            recording[-4]


def test_closed_file_is_refused(path):
    recording = open_recording(path)
    recording.close()
    recording.close()
    with pytest.raises(DataError, match=r"rec.h5 is closed; open it again"):
        recording[0]


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("ertis_format_version", "abc", "not of this package"),
        ("ertis_format_version", np.array([1, 1]), "not of this package"),
        ("ertis_format", np.array([1, 1]), "not of this package"),
    ],
)
def test_odd_attributes_are_refused(tmp_path, name, value, match):
    path = write_recording(tmp_path / "rec.h5", noise())
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(DataError, match=match):
        open_recording(path)


def test_scalar_words_are_refused(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise())
    with h5py.File(path, "r+") as file:
        (group,) = file["sensors"].values()
        del group["pdm"]
        group["pdm"] = 1
    with pytest.raises(DataError, match=r"pdm has shape \(\), wanted \(time, sample, word\)"):
        open_recording(path)


def test_sensor_of_several_must_be_chosen(path):
    with h5py.File(path, "r+") as file:
        file.copy(GROUP, file["sensors"], name="other")
    with pytest.raises(ArgumentError, match=r"choose one of eRTIS-7, other \(sensor\)"):
        open_recording(path)
    with pytest.raises(ArgumentError, match="has no sensor 'none'; choose one of eRTIS-7, other"):
        open_recording(path, sensor="none")
    with open_recording(path, sensor="other") as recording:
        assert recording[0].stamp.sensor == "other"


def test_any_damaged_bit_is_found(tmp_path):
    """For any bit, reading returns the original or raises a `DataError` of one line."""
    given = noise(line(8, 8).replace(recording=Recording(n_samples=512)), 2)
    wall = Reflector(name="wall", azimuth_deg=10.0, elevation_deg=20.0, range_m=1.5, level_db=0.0)
    reported = GroundTruth(scene="", seed=1, reflectors=((), (wall,)))
    path = write_recording(tmp_path / "rec.h5", given, truth={"eRTIS-7": reported})
    with open_recording(path) as recording:
        reported = recording.truth
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    refusals = []
    for place in rng.integers(0, len(whole), 100):  # `make soak` tries many more
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(spoilt)
        try:
            with open_recording(path) as recording:
                assert recording.truth == reported
                for back, measurement in zip(recording, given, strict=True):
                    assert np.array_equal(back.data, measurement.data)
                    assert back.stamp == measurement.stamp
        except DataError as error:
            refusals.append(str(error))
    assert len(refusals) > 10
    assert not any("\n" in refusal for refusal in refusals)


def test_changed_settings_are_found(path):
    with h5py.File(path, "r+") as file:
        text = file[f"{GROUP}/settings"]
        text[()] = text[()].replace(b"temperature_c = 20.0", b"temperature_c = 25.0")
    with pytest.raises(DataError, match=r"the content of sensor eRTIS-7 has SHA-256 .*: the file is damaged; copy it"):
        open_recording(path)


def test_full_disk_leaves_no_file(tmp_path, monkeypatch):
    free = shutil.disk_usage(tmp_path).free
    monkeypatch.setattr(atomic_files, "RESERVED_BYTES", 2 * free)
    with pytest.raises(
        DataError,
        match=r"MB free, but [\d.]+ MB are needed for the next data, including a reserve of \d+ MB; free some",
    ):
        write_recording(tmp_path / "rec.h5", noise())
    assert not list(tmp_path.iterdir())


WRITE_UNDER_A_LIMIT = """
import sys
import tests.files as files
from ertis_numba.base.errors import DataError
from ertis_numba.storage import write_recording

try:
    write_recording(sys.argv[1], files.noise(count=30))
except DataError as error:
    print(error)
    raise SystemExit(7)
"""


def test_disk_error_while_writing_leaves_no_file(tmp_path):
    """The limit on the size of a file replaces a full disk: writing fails in the same way."""
    done = subprocess.run(
        [sys.executable, "-c", WRITE_UNDER_A_LIMIT, tmp_path / "rec.h5"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000)),
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (7, "")
    assert "rec.h5 cannot be written (File too large); free some space or write elsewhere" in done.stdout
    assert not list(tmp_path.iterdir())
