"""Raw files become measurements, or are refused in one line."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.interop import open_raw
from ertis_numba.settings import Array, Recording, Settings
from tests.files import line, noise

SHORT = Settings.from_preset("short_25_50")
N_BYTES = 4 * 65_536


def test_measurements_have_the_order_of_the_files(tmp_path):
    words = [measurement.data for measurement in noise(SHORT)]
    (tmp_path / "one.bin").write_bytes(words[0].tobytes())
    (tmp_path / "two.bin").write_bytes(words[1].tobytes() + words[2].tobytes())
    raw = open_raw([tmp_path / "one.bin", str(tmp_path / "two.bin")], SHORT, sensor="left")
    assert len(raw) == 3
    for _ in range(2):  # it can be read again
        for index, (measurement, given) in enumerate(zip(raw, words, strict=True)):
            assert measurement.data.dtype == np.uint32
            assert np.array_equal(measurement.data, given)
            assert measurement.settings is SHORT
            assert (measurement.stamp.sensor, measurement.stamp.sequence) == ("left", index)


@pytest.mark.parametrize("settings", [line(8, 8), line(70, 16), line(64, 64)], ids=["8", "70 in 16", "64"])
def test_raw_import_accepts_words_of_any_size(tmp_path, settings):
    (given,) = noise(settings, 1)
    (tmp_path / "raw.bin").write_bytes(given.data.tobytes())
    (back,) = open_raw(tmp_path / "raw.bin", settings)
    assert np.array_equal(back.data, given.data)


def test_word_is_little_endian_and_bit_0_is_channel_0(tmp_path):
    settings = SHORT.replace(recording=Recording(n_samples=1))
    (tmp_path / "raw.bin").write_bytes(b"\x01\x00\x00\x80")
    (measurement,) = open_raw(tmp_path / "raw.bin", settings)
    assert measurement.data.tolist() == [0x80000001]


@pytest.mark.parametrize(
    ("n_bytes", "message"),
    [
        (0, r"raw.bin is empty, wanted a multiple of 262144 \(65536 words of 4 bytes\); record it again"),
        (N_BYTES - 1, r"raw.bin has 262143 bytes, which is not a multiple of a word, wanted a multiple of 262144"),
        (
            N_BYTES - 4,
            r"raw.bin has 262140 bytes, wanted a multiple of 262144 .*; copy it again if it is",
        ),
        (N_BYTES + 4, r"raw.bin has 262148 bytes, wanted a multiple of 262144"),
        (
            4 * 163_840,
            r"raw.bin has 655360 bytes, wanted a multiple of 262144 .*; its length fits the presets default_…",
        ),
    ],
)
def test_raw_files_of_invalid_lengths_are_refused(tmp_path, n_bytes, message):
    (tmp_path / "raw.bin").write_bytes(bytes(n_bytes))
    with pytest.raises(DataError, match=message):
        open_raw(tmp_path / "raw.bin", SHORT)


@pytest.mark.parametrize(
    ("settings", "n_bytes", "message"),
    [
        pytest.param(line(8, 8), 163_840, r"its length fits the presets default_…$", id="8"),
        pytest.param(line(70, 16), 2 * 5 * 65_536, r"its length fits the presets short_…$", id="70 in 16"),
        pytest.param(line(64, 64), 4 * 163_840, r"copy it again if it is cut short", id="half of 64"),
    ],
)
def test_suggested_presets_depend_on_the_array(tmp_path, settings, n_bytes, message):
    settings = settings.replace(recording=Recording(n_samples=100_003))
    (tmp_path / "raw.bin").write_bytes(bytes(n_bytes))
    with pytest.raises(DataError, match=message):
        open_raw(tmp_path / "raw.bin", settings)


def test_unreadable_raw_paths_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"none.bin: No such file or directory; choose a file of raw words"):
        open_raw(tmp_path / "none.bin", SHORT)
    with pytest.raises(DataError, match="is a folder; choose a file of raw words"):
        open_raw(tmp_path, SHORT)
    with pytest.raises(ArgumentError, match="no raw file is passed; pass at least one"):
        open_raw([], SHORT)
    with pytest.raises(ArgumentError, match="layout 'nothing' is unknown"):
        open_raw(tmp_path, SHORT.replace(array=Array(layout="nothing")))


def test_raw_file_that_shrinks_is_reported(tmp_path):
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(2 * N_BYTES))
    raw = iter(open_raw(path, SHORT))
    next(raw)
    path.write_bytes(bytes(N_BYTES))
    with pytest.raises(DataError, match="became shorter while it was read; copy it again"):
        next(raw)
