"""Formats that are recognized by their first bytes, wherever files of other programs come in."""

import bz2
import gzip
import io
import json
import lzma
import pickle
import re
import sqlite3
import struct
import tarfile
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

import ertis_numba as ertis
from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import kind_of, markup_of, problem_of

RECORDING = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
N_WORDS = 65_536
VALUES = np.random.default_rng(1).integers(-3_000, 3_000, (3_000, 2)).astype("<i2")
SETTINGS = ertis.Settings().replace("recording.n_samples", N_WORDS)


def written(write):
    """Return the bytes that a function writes to a file in memory."""
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def archive(buffer):
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("a.wav", b"RIFF")


def tarball(buffer):
    with tarfile.open(fileobj=buffer, mode="w") as file:
        file.addfile(tarfile.TarInfo("a.wav"))


def hdf5(buffer):
    with h5py.File(buffer, "w") as file:
        file["a"] = VALUES


def mp3():
    """Two frames of MPEG 1, layer III: 128 kbit/s at 44.1 kHz, 417 bytes each."""
    return (b"\xff\xfb\x90\x00" + bytes(413)) * 2


def words(seed=0, n_words=N_WORDS):
    return np.random.default_rng(seed).integers(0, 2**32, n_words, dtype=np.uint32).tobytes()


MADE = {
    # content by other libraries or by the definition of the format, and the name
    "wav": (written(lambda buffer: wavfile.write(buffer, 96_000, VALUES)), "a WAV file"),
    "rf64": (b"RF64\xff\xff\xff\xffWAVEds64", "a WAV file"),
    "bw64": (b"BW64\xff\xff\xff\xffWAVEds64", "a WAV file"),
    "rifx": (b"RIFX\0\0\x10\0WAVEfmt ", "a WAV file"),
    "avi": (b"RIFF\0\x10\0\0AVI LIST", "an AVI video"),
    "webp": (b"RIFF\0\x10\0\0WEBPVP8 ", "a RIFF file of another form"),
    "w64": (bytes.fromhex("726966662e91cf11a5d628db04c10000") + bytes(99), "a Sony Wave64 file"),
    "flac": (b"fLaC\0\0\0\x22" + bytes(99), "a FLAC file"),
    "ogg": (b"OggS\0\2" + bytes(99), "an Ogg file"),
    "mp3": (b"ID3\3\0\0\0\0\0\0" + mp3(), "an MP3 file"),
    "bare.mp3": (mp3(), "an MP3 or AAC file"),
    "aac": ((b"\xff\xf1\x50\x80\x02\x1f\xfc" + bytes(9)) * 2, "an MP3 or AAC file"),
    "aiff": (b"FORM\0\0\x10\0AIFFCOMM", "an AIFF file"),
    "aifc": (b"FORM\0\0\x10\0AIFCFVER", "an AIFF-C file"),
    "caf": (b"caff\0\1\0\0desc", "a CAF file"),
    "au": (b".snd\0\0\0\x18", "a Sun AU file"),
    "ircam.sf": (bytes.fromhex("64a30300") + bytes(99), "an IRCAM file"),
    "pvf": (b"PVF1\n2 48000 32\n" + bytes(99), "a PVF file"),
    "avr": (b"2BIT" + bytes(99), "an AVR file"),
    "m4a": (b"\0\0\0\x20ftypM4A ", "an MP4 file"),
    "mat": (written(lambda buffer: scipy.io.savemat(buffer, {"x": VALUES})), "a MATLAB file"),
    "old.mat": (written(lambda buffer: scipy.io.savemat(buffer, {"x": VALUES}, format="4")), "a MATLAB file"),
    "new.mat": (b"MATLAB 7.3 MAT-file, ".ljust(512) + written(hdf5), "a MATLAB file"),
    "h5": (written(hdf5), "an HDF5 file"),
    "block.h5": (bytes(512) + written(hdf5), "an HDF5 file"),
    "npy": (written(lambda buffer: np.save(buffer, VALUES)), "a NumPy file"),
    "npz": (written(lambda buffer: np.savez(buffer, x=VALUES)), "a NumPy archive"),
    "zip": (written(archive), "a ZIP archive"),
    "tar": (written(tarball), "a tar archive"),
    "gz": (gzip.compress(VALUES.tobytes()), "a gzip file"),
    "bz2": (bz2.compress(VALUES.tobytes()), "a bzip2 file"),
    "xz": (lzma.compress(VALUES.tobytes()), "an xz file"),
    "zst": (bytes.fromhex("28b52ffd") + bytes(9), "a Zstandard file"),
    "7z": (bytes.fromhex("377abcaf271c0004"), "a 7-Zip archive"),
    **{f"{number}.pkl": (pickle.dumps(VALUES, protocol=number), "a Python pickle") for number in range(2, 6)},
    "parquet": (b"PAR1" + bytes(99) + b"PAR1", "a Parquet file"),
    "arrow": (b"ARROW1\0\0", "an Arrow file"),
    "tdms": (b"TDSm\x0e\0\0\0", "a TDMS file of LabVIEW"),
    "bag": (b"#ROSBAG V2.0\n", "a ROS 1 bag"),
    "mcap": (b"\x89MCAP0\r\n", "an MCAP file"),
    "png": (b"\x89PNG\r\n\x1a\n", "a PNG image"),
    "jpg": (b"\xff\xd8\xff\xe0\0\x10JFIF", "a JPEG image"),
    "tif": (struct.pack("<2sHI", b"II", 42, 8), "a TIFF image"),
    "pointer.wav": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "a pointer of Git LFS"),
    "page.wav": (b"<!DOCTYPE html>\n<html></html>\n", "an HTML page"),
    "pdf": (b"%PDF-1.7\n%\xe2\xe3", "a PDF document"),
    "elf": (b"\x7fELF\2\1\1", r"a program \(ELF\)"),
    "csv": (b"time_s,x\n0.0,1.0\n1.0,2.0\n", "a text file"),
    "json": (json.dumps({"rate": 1}).encode(), "a text file"),
    "xml": (b"<?xml version='1.0'?><a/>", "a text file"),
    "utf8.txt": ("Zeit in µs;b\n1;2\n".encode() * 900, "a text file"),
    "utf16.txt": ("a,b\n1,2\n".encode("utf-16") * 9, "a text file"),
    "latin1.txt": ("Zeit in µs;b\n1;2\n".encode("latin-1") * 9, "a text file"),
}


@pytest.mark.parametrize("ending", MADE)
def test_kind_of_names_common_formats(tmp_path, ending):
    content, name = MADE[ending]
    path = tmp_path / f"take.{ending}"
    path.write_bytes(content)
    assert name.replace("\\", "") in kind_of(path).name
    with pytest.raises(
        DataError,
        match=rf"take\.{ending} is {name}.*; if the file contains raw words .*nevertheless, use check_kind=False",
    ):
        ertis.open_raw(path, SETTINGS)
    if not kind_of(path).is_hdf5:
        with pytest.raises(DataError, match=rf"take\.{ending} is {name}"):
            ertis.open_recording(path)


def test_kind_of_names_databases(tmp_path):
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("create table a (b)")
    database.close()
    assert problem_of(tmp_path / "a.db").startswith(
        "is an SQLite database; if it is a journal, seal it with 'ertis imp"
    )


WORDS = {
    "random": words(),
    "zeros": bytes(4 * N_WORDS),
    "ones": b"\xff" * 4 * N_WORDS,
    "idle": b"\x55" * 4 * N_WORDS,
    "other idle": b"\x33" * 4 * N_WORDS,
    "alternating words": b"\xff\xfb\x90\0" * N_WORDS,
    "two channels": b"\xaa\xaa\x55\x55" * N_WORDS,
}


@pytest.mark.parametrize("name", WORDS)
def test_raw_words_are_no_other_format(tmp_path, name):
    path = tmp_path / "take.bin"
    path.write_bytes(WORDS[name])
    assert (kind_of(path), problem_of(path)) == (None, "")
    assert len(ertis.open_raw(path, SETTINGS)) == 1


def test_random_words_are_no_other_format(tmp_path):
    path = tmp_path / "take.bin"
    for seed in range(300):
        path.write_bytes(words(seed, 2_000))
        assert kind_of(path) is None, seed


def test_kind_of_missing_and_empty_files_is_unknown(tmp_path):
    (tmp_path / "empty").touch()
    assert kind_of(tmp_path / "empty") is None
    assert kind_of(tmp_path / "missing") is None
    assert kind_of(tmp_path) is None


def test_open_raw_reads_any_content_on_demand(tmp_path):
    path = tmp_path / "take.bin"
    path.write_bytes(b"fLaC" + words()[4:])
    with pytest.raises(DataError, match=r"take\.bin is a FLAC file; convert it with 'ffmpeg -i .*take_pcm\.wav'"):
        ertis.open_raw(path, SETTINGS)
    (measurement,) = ertis.open_raw(path, SETTINGS, check_kind=False)
    assert measurement.data.tobytes().startswith(b"fLaC")


def invoke(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture
def raw_settings(tmp_path):
    (tmp_path / "raw.toml").write_text(f'[array]\nlayout = "eRTIS_v3D1"\n[recording]\nn_samples = {N_WORDS}\n')
    return ("--settings", tmp_path / "raw.toml", "-o", tmp_path / "out.h5")


@pytest.mark.parametrize("more", [[], ["--passive"]], ids=["active", "passive"])
@pytest.mark.parametrize("name", ["take.flac", "take.bin", "take.wav", "take"])
def test_import_refuses_other_formats_under_any_name(tmp_path, raw_settings, name, more):
    (tmp_path / name).write_bytes(b"fLaC" + words()[4:])
    done = invoke("import", "signals", tmp_path / name, *raw_settings, *more)
    assert done.exit_code == 1
    assert f"{name} is a FLAC file; convert it with 'ffmpeg -i {tmp_path / name} -c:a pcm_f32le" in done.stderr
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("name", ["take.wav", "take.WAV", "take.wave", "take.bin", "take"])
def test_import_reads_wav_by_its_content(tmp_path, name):
    wavfile.write(tmp_path / "a", 96_000, np.tile(VALUES, (4, 1)))
    (tmp_path / "a").rename(tmp_path / name)
    (tmp_path / "pair.csv").write_text("0,0,0\n0,20,0\n")
    done = invoke(
        "import", "signals", tmp_path / name, "--layout", tmp_path / "pair.csv", "--passive", "-o", tmp_path / "out.h5"
    )
    assert done.exit_code == 0, done.stderr
    with ertis.open_recording(tmp_path / "out.h5") as recording:
        assert np.array_equal(recording[0].data, np.tile(VALUES, (4, 1)))


@pytest.mark.parametrize("name", ["take.xyz", "take", "take.bin.part"])
def test_import_of_unknown_endings_needs_raw(tmp_path, raw_settings, name):
    (tmp_path / name).write_bytes(words())
    done = invoke("import", "signals", tmp_path / name, *raw_settings)
    assert done.exit_code == 2
    assert (
        f"{name} has unknown content and an unknown ending; use --raw if the file contains raw eRTIS words"
        in done.stderr
    )
    assert invoke("import", "signals", tmp_path / name, *raw_settings, "--raw").exit_code == 0


@pytest.mark.parametrize("name", ["take.bin", "take.RAW", "take.dat", "take.pdm"])
def test_import_reads_raw_words_of_known_endings(tmp_path, raw_settings, name):
    (tmp_path / name).write_bytes(words())
    done = invoke("import", "signals", tmp_path / name, *raw_settings)
    assert done.exit_code == 0, done.stderr
    passive = invoke("import", "signals", tmp_path / name, *raw_settings, "--force", "--passive")
    assert (
        f"--passive is for PCM (.wav, .h5), but {tmp_path / name} contains raw words; remove --passive"
        in passive.stderr
    )


@pytest.mark.parametrize("command", ["info", "process", "verify", "sensors check", "export"])
def test_commands_name_a_wav_file_and_its_import(tmp_path, command):
    wavfile.write(tmp_path / "take.wav", 96_000, VALUES)
    target = ["-o", tmp_path / "out.csv"] if command == "export" else []
    done = invoke(*command.split(), tmp_path / "take.wav", *target)
    assert done.exit_code == 1
    assert (
        f"take.wav is a WAV file; import it with 'ertis import signals {tmp_path}/take.wav --settings FILE"
        in done.stderr
    )


IMAGES = "choose an energyscape file"


@pytest.mark.parametrize("ending", ["wav", "TOML", "tum", "npz"])
def test_recordings_are_not_written_under_names_of_other_formats(tmp_path, ending):
    measurement = ertis.Measurement(np.zeros(N_WORDS, np.uint32), SETTINGS, ertis.Stamp())
    with pytest.raises(
        ertis.ArgumentError, match=rf"take\.{ending} ends in \.{ending}, but the file is HDF5; choose a n"
    ):
        ertis.write_recording(tmp_path / f"take.{ending}", [measurement])
    assert not [*tmp_path.iterdir()]


OVERWRITING = (
    "import poses rec.h5 poses.tum -o poses.tum",
    "import poses rec.h5 poses.tum --times times.txt -o times.txt",
    "map rec.h5 --poses poses.tum -o poses.tum",
    "odometry rec.h5 --mounting poses.tum -o poses.tum",
    "sensors calibrate rec.h5 --layout mine.toml -o mine.toml",
    "process rec.h5 --settings mine.toml -o mine.toml",
    "import signals times.txt --raw --settings mine.toml -o mine.toml",
    "export rec.h5 --mounting mine.toml -o mine.toml",
    "view rec.h5 --mounting mine.toml --save-html ./mine.toml",
)


@pytest.mark.parametrize("command", OVERWRITING)
def test_no_command_overwrites_one_of_its_inputs(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    for name in ("rec.h5", "poses.tum", "times.txt", "mine.toml"):
        (tmp_path / name).write_text("precious")
    done = invoke(*command.split(), "--force")
    assert done.exit_code == 1
    assert re.search(r"^ertis: error: output \S+ is the input itself; choose another name\n$", done.stderr)
    assert all(path.read_text() == "precious" for path in tmp_path.iterdir())


WANTED = {
    "peaks": f"{IMAGES} or a file of acoustic maps ('ertis process' and 'ertis acoustic' write them)",
    "compare": IMAGES,
    "map -o map.h5": "choose a recording, or save its signals as WAV",
    "odometry": "choose a recording, or save its signals as WAV",
    "sensors calibrate": "choose a recording, or save its signals as WAV",
    "odometry REC --mounting": "choose a scene or mounting file (.toml), or a file of ertis that contains mountings",
    "map REC -o map.h5 --poses": "the first line names the columns some, words",
}


@pytest.mark.parametrize("command", WANTED)
def test_remedy_for_a_text_file_is_what_the_command_takes(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("some words\nand some more\n")
    done = invoke(*command.replace("REC", str(RECORDING)).split(), "notes.txt")
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("ertis: error: notes.txt")
    assert WANTED[command] in done.stderr


def test_markup_of_names_json_and_accepts_toml():
    assert markup_of('{"seed": 1}') == "JSON"
    assert markup_of("seed = 1") is None
