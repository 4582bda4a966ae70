"""Inputs of the wrong kind: the message names the kind that was found, and a remedy that works."""

import struct

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError, SettingsError
from ertis_numba.storage import write_recording
from tests.files import noise

SCENE = "[[points]]\nrange_m = 1.0\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with files of many kinds."""
    folder = tmp_path_factory.mktemp("files")
    for name in ("empty", "recs"):
        (folder / name).mkdir()
    write_recording(folder / "rec.h5", noise())
    write_recording(folder / "recs" / "first.h5", noise())
    random = np.random.default_rng(1)
    wavfile.write(folder / "a.wav", 192_000, random.normal(0, 900, (1920, 4)).astype("<i2"))
    wavfile.write(folder / "nan.wav", 192_000, np.full((1920, 4), np.nan, "f4"))
    wavfile.write(folder / "none.wav", 192_000, np.zeros((0, 4), "<i2"))
    (folder / "zero.wav").touch()
    (folder / "lay.csv").write_text("y_mm,z_mm\n0,0\n20,0\n0,20\n20,20\n")
    (folder / "a.tum").write_text("1700000000.5 1 2 3 0 0 0 1\n")
    (folder / "a.bin").write_bytes(bytes(262_144))
    (folder / "s.json").write_text('{"seed": 1}\n')
    (folder / "s.xml").write_text("<scene/>\n")
    (folder / "latin.toml").write_bytes(b"# H\xf6he\nseed = 1\n")
    (folder / "short.csv").write_text("1,2\n")
    (folder / "template.toml").write_text("# seed = 0\n")
    return folder


def run(folder, monkeypatch, line):
    monkeypatch.chdir(folder)
    return CliRunner().invoke(cli, [argument.strip("'") for argument in line.split()])


CASES = {  # command: exit code and message
    "simulate rec.h5 -o o.h5": (
        1,
        "rec.h5 is an HDF5 file; choose a scene file (TOML); 'ertis info rec.h5' describes this file",
    ),
    "simulate a.wav -o o.h5": (1, "a.wav is a WAV file; choose a scene file (TOML)"),
    "simulate s.json -o o.h5": (1, "s.json is JSON, not TOML; choose a scene file (TOML)"),
    "simulate s.xml -o o.h5": (1, "s.xml is XML, not TOML; choose a scene file (TOML)"),
    "simulate latin.toml -o o.h5": (1, "it is not text in UTF-8 (byte 0xf6 at position 3); save it as UTF-8"),
    "simulate template.toml -o o.h5": (
        1,
        "sets no key; add sensors, reflectors or sources, see 'ertis reference settings scene'",
    ),
    "simulate recs -o o.h5": (1, "recs: Is a directory; choose a scene file (TOML)"),
    "process rec.h5 --settings lay.csv -o o.h5": (1, "lay.csv is not TOML; choose a settings file (TOML)"),
    "info latin.toml": (1, "latin.toml is a text file; simulate a scene with 'ertis simulate latin.toml', and use"),
    "process a.tum": (1, "a text file; add these poses to a recording with 'ertis import poses REC.h5 a.tum'"),
    "import poses a.tum rec.h5": (2, "the recording comes before the poses; use 'ertis import poses rec.h5 a.tum'"),
    "import signals a.wav a.bin --passive --layout lay.csv -o o.h5": (
        2,
        "some files are PCM (.wav, .h5) and others are raw",
    ),
    "--config a.wav info rec.h5": (1, "a.wav: it is not text in UTF-8 (byte 0x"),
    "info short.csv": (1, "short.csv is a text file; choose a recording, or save its signals as WAV"),
    "process rec.h5 --preset set.toml -o o.h5": (1, "is the name of a file; load it as settings (--settings)"),
    "record --output ''": (2, "the path is empty; name a folder"),
    "sensors emulate s.json": (1, "s.json is a text file; choose a recording"),
    "process rec.h5 --settings a.wav -o o.h5": (1, "a.wav is a WAV file; choose a settings file (TOML)"),
    "odometry recs": (1, "recs is a folder; choose a recording, such as recs/first.h5"),
    "odometry empty": (1, "empty is a folder; choose a recording\n"),
    "odometry 'x*.h5'": (2, "no file matches x*.h5; choose another pattern, or name the files"),
    "sensors calibrate 'x*.h5'": (2, "no file matches x*.h5"),
    "import signals 'x*.wav' --passive --layout lay.csv": (2, "no file matches x*.wav"),
    "peaks 're*.h5'": (1, "such as rec.h5"),
    "info ''": (2, "the path is empty; name a file"),
    "import signals a.wav --layout '' --passive -o o.h5": (2, "--layout is empty; write a value, or leave it out"),
    "process rec.h5 recs/first.h5 -o o.h5": (
        2,
        "-o o.h5 names a file, but several recordings need a folder; use -o o/",
    ),
    "process rec.h5 --emitter-diameter 0.01": (2, "No such option '--emitter-diameter'"),
    "plot rec.h5 -o recs": (1, "picture recs is a folder; name a file in it that ends in"),
    "plot rec.h5 -o name": (1, "picture name has no ending; choose a name that ends in"),
    "export rec.h5 -o name.xyz": (1, "export name.xyz ends in '.xyz'; choose a name that ends in"),
    "import signals zero.wav --layout lay.csv": (1, "zero.wav is empty; record or copy it again, or leave it out"),
    "import signals none.wav --layout lay.csv": (1, "none.wav has no samples"),
    "import signals nan.wav --layout lay.csv": (1, "channel 0 of nan.wav contains NaN or infinity"),
    "import signals nan.wav": (1, "channel 0 of nan.wav contains NaN or infinity"),
    "import signals gone.wav --layout lay.csv": (
        1,
        "gone.wav: No such file or directory; choose a file with measurements",
    ),
    "import signals a.wav --passive --layout lay.csv --start 18/05/2024T04:25": (
        2,
        "'18/05/2024T04:25' is not a date with a time; write year, month and day first, as in 2026-05-04T12:30",
    ),
    "import signals a.wav --layout lay.csv": (2, "the call in a.wav is unknown; use --passive"),
    "serve --every --json": (2, "--every requires --record DIR; add --record DIR, or leave out --every"),
    "serve --every --record d": (2, "--every requires --json; add --json"),
    "serve --rotate-size 5": (2, "--rotate-size requires --record DIR"),
    "record -o d --every": (2, "--every requires --json; add --json"),
    "sensors calibrate rec.h5 --sensors a,b": (2, "--sensors requires --poses; add --poses, or choose one sensor"),
}


@pytest.mark.parametrize("line", CASES)
def test_wrong_kind_of_input_is_named_with_a_remedy(folder, monkeypatch, line):
    code, message = CASES[line]
    before = sorted(folder.rglob("*"))
    done = run(folder, monkeypatch, line)
    assert done.exit_code == code, done.output
    assert message in done.stderr
    assert done.stderr.count("ertis: error:") == 1
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_scene_of_powershell_is_read(tmp_path, encoding):
    (tmp_path / "s.toml").write_bytes(SCENE.encode(encoding))
    assert len(ertis.load_scene(tmp_path / "s.toml").points) == 1


def test_patterns_are_expanded(folder, monkeypatch):
    done = run(folder, monkeypatch, "verify '*.h5' 'recs/*.h5' --quiet --json")
    assert done.exit_code == 0, done.output
    assert [name in done.stdout for name in ("rec.h5", "first.h5")] == [True, True]


def test_patterns_are_expanded_in_the_order_of_numbers(tmp_path, monkeypatch):
    for number in (1, 2, 10):
        wavfile.write(tmp_path / f"mic{number}.wav", 96_000, np.full(960, number, "<i2"))
    (tmp_path / "three.csv").write_text("y_mm,z_mm\n0,0\n20,0\n0,20\n")
    done = run(tmp_path, monkeypatch, "import signals 'mic*.wav' --join --passive --layout three.csv -o o.h5")
    assert done.exit_code == 0, done.output
    with ertis.open_recording(tmp_path / "o.h5") as recording:
        assert recording[0].data[0].tolist() == [1, 2, 10]


def test_words_without_sound_are_noted(tmp_path, monkeypatch):
    for name, word in (("zeros", 0), ("ones", 0xFFFFFFFF), ("alternate", 0x55555555)):
        (tmp_path / f"{name}.bin").write_bytes(struct.pack("<I", word) * 65_536)
    np.random.default_rng(1).integers(0, 2**32, 65_536, dtype=np.uint32).tofile(tmp_path / "noise.bin")
    end = "-o o.h5 --force --layout eRTIS_v3D1 --preset short_25_50"
    done = run(tmp_path, monkeypatch, f"import signals noise.bin zeros.bin ones.bin alternate.bin {end}")
    assert done.exit_code == 0, done.output
    assert "all words of measurement 1 (and 2 more) are equal, so no microphone recorded anything" in done.stderr
    assert "are equal" not in run(tmp_path, monkeypatch, f"import signals noise.bin {end}").stderr


def test_python_names_the_kind_of_a_file(folder):
    with pytest.raises(SettingsError, match=r"a\.wav is a WAV file; choose a settings file"):
        ertis.Settings.load(folder / "a.wav")
    with pytest.raises(DataError, match=r"recs is a folder; choose .*, such as .*first\.h5"):
        ertis.open_recording(folder / "recs")
    with pytest.raises(ArgumentError, match=r"map .*recs is a folder; name a file in it that ends in \.h5"):
        ertis.write_map(folder / "recs", ertis.OccupancyMap(np.zeros((3, 3)), (0.0, 0.0), 0.05))


def test_page_without_the_chosen_band_is_noted(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    commands = (
        f"import signals {folder / 'a.wav'} --layout {folder / 'lay.csv'} --passive -o a.h5 --quiet",
        "acoustic a.h5 -o maps.h5 --directions 2d:19 --quiet",
    )
    for line in commands:
        assert run(tmp_path, monkeypatch, line).exit_code == 0
    done = run(tmp_path, monkeypatch, "view maps.h5 --save-html a.html --band 1e9")
    assert done.exit_code == 0, done.output
    assert done.stderr.count("no map has a band at 1e+06 kHz, so the page shows none; choose a frequency from") == 1
    assert "no map has" not in run(tmp_path, monkeypatch, "view maps.h5 --save-html b.html --band 20000").stderr
