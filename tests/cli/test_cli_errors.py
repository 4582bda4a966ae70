"""Invalid input ends in one line with the value, the accepted values and the remedy, and writes no file."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import options
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Stamp
from ertis_numba.storage import GroundTruth, open_recording, write_energyscapes, write_recording
from tests.files import image, noise

N_BYTES = 4 * 65_536
RAW = "import signals {} -o out.h5 --layout eRTIS_v3D1 --preset short_25_50"
CASES = {
    # raw samples
    "missing raw file": (RAW.format("none.bin"), 1, "none.bin: No such file or directory"),
    "empty raw file": (RAW.format("empty.bin"), 1, "empty.bin is empty; record or copy it again, or leave it out"),
    "odd raw file": (RAW.format("odd.bin"), 1, "odd.bin has 262143 bytes, which is not a multiple of a word"),
    "truncated raw file": (RAW.format("cut.bin"), 1, "cut.bin has 262140 bytes, wanted a multiple of 262144"),
    "one good, one bad": (RAW.format("good.bin odd.bin"), 1, "odd.bin has 262143 bytes"),
    "folder for raw file": (RAW.format("folder"), 2, "folder contains no files to import; choose a folder with .wav"),
    "unknown layout": (
        "import signals good.bin -o out.h5 --layout eRTIS_v3D --preset short_25_50",
        2,
        "layout 'eRTIS_v3D' is unknown (did you mean 'eRTIS_v3D1'?); known are eRTIS_v2",
    ),
    "missing layout file": (
        "import signals good.bin -o out.h5 --layout none.csv --preset short_25_50",
        1,
        "layout none.csv: No such file or directory",
    ),
    "NaN in layout": (
        "import signals good.bin -o out.h5 --layout nan.csv --preset short_25_50",
        1,
        "layout nan.csv, line 2: z is nan; use a finite number",
    ),
    "unknown preset": (
        "import signals good.bin -o out.h5 --layout eRTIS_v2 --preset short_30_50",
        2,
        "preset 'short_30_50' is unknown (did you mean 'short_25_50'?); known are short_20_80",
    ),
    "no layout": ("import signals good.bin -o out.h5 --preset short_25_50", 2, "Missing option '--layout'"),
    "no raw file": ("import signals --layout eRTIS_v2 --preset short_25_50", 2, "Missing argument 'FILE...'"),
    "temperature": (
        RAW.format("good.bin") + " --temperature nan",
        2,
        "--temperature is nan; use a finite number",
    ),
    "sensor name": (
        RAW.format("good.bin") + " --sensor a/b",
        2,
        "sensor name 'a/b' cannot name a group in a file; use",
    ),
    # recordings
    "missing recording": ("process none.h5 -o out.h5", 1, "none.h5: No such file or directory; choose a recording"),
    "empty recording": ("process empty.h5 -o out.h5", 1, "empty.h5 is empty; choose a recording"),
    "not HDF5": ("process good.bin -o out.h5", 1, "good.bin is not an HDF5 file; choose a recording"),
    "HDF5 of others": (
        "process other.h5 -o out.h5",
        1,
        "other.h5 is HDF5, but not of this package; choose a recording",
    ),
    "energyscapes instead": ("process img.h5 -o out.h5", 1, "img.h5 is an energyscape file, wanted a recording; use"),
    "recording instead": ("peaks rec.h5", 1, "rec.h5 is a recording, wanted an energyscape file; process it first"),
    "cut short": ("process cut.h5 -o out.h5", 1, "cut.h5 is cut short or damaged: it has"),
    "newer": ("process newer.h5 -o out.h5", 1, "newer.h5 has format version 9, but this package reads up to 4; update"),
    "damaged words": ("process damaged.h5 -o out.h5", 1, "damaged.h5: measurement 1 has CRC-32"),
    "NaN in calibration": (
        "process nan.h5 -o out.h5",
        1,
        "nan.h5: calibration_gain of channel 3 is nan, but the settings",
    ),
    "info of nothing": (
        "info folder",
        1,
        "folder: no file in this folder ends in .h5; choose a folder with recordings or results",
    ),
    # processing
    "no directions": ("process rec.h5 -o out.h5 --directions 2d:0", 2, "count of directions '2d:0' is 0; use a whole"),
    "empty directions": (
        "process rec.h5 -o out.h5 --directions 3d:",
        2,
        "directions '3d:' has no count; use a number",
    ),
    "unknown directions": ("process rec.h5 -o out.h5 --directions 4d:3", 2, "directions '4d:3' is not a grid; use 90"),
    "empty CSV": (
        "process rec.h5 -o out.h5 --directions empty.csv",
        1,
        "directions empty.csv does not have two numbers",
    ),
    "missing CSV": ("process rec.h5 -o out.h5 --directions none.csv", 1, "directions none.csv: No such file"),
    "range outside": ("process rec.h5 -o out.h5 --range 1:50", 1, "--range ends at 50 m, but the record"),
    "range backwards": ("process rec.h5 -o out.h5 --range 3:1", 2, "--range runs from 3 to 1; use the"),
    "range NaN": ("process rec.h5 -o out.h5 --range nan:1", 2, "--range is nan; use a finite number"),
    "no range": ("process rec.h5 -o out.h5 --range 3", 2, "'3' is not an interval; use two numbers, as in 0.5:5"),
    "limits of a paper grid": (
        "process rec.h5 -o out.h5 --directions 90 --azimuth -9:9",
        2,
        "directions 90 have fixed limits; use --directions 2d:N or 3d:N with limits; see 'ertis process --help'",
    ),
    "limits of a CSV": (
        "process rec.h5 -o out.h5 --directions mine.csv --azimuth -9:9",
        2,
        "mine.csv have fixed limits",
    ),
    "elevation of a plane": (
        "process rec.h5 -o out.h5 --directions 2d:9 --elevation 20:50",
        2,
        "directions 2d:9 lie at one elevation; use --elevation E, or --directions 3d:N; see",
    ),
    "one elevation of a solid angle": (
        "process rec.h5 -o out.h5 --directions 3d:9 --elevation 20",
        2,
        "directions 3d:9 lie between two elevations; use --elevation A:B, or --directions 2d:N; see",
    ),
    "elevation of a paper grid": (
        "process rec.h5 -o out.h5 --directions 90 --elevation 20",
        2,
        "directions 90 have fixed limits; use --directions 2d:N or 3d:N with limits; see",
    ),
    "elevation above the zenith": (
        "process rec.h5 -o out.h5 --directions 2d:9 --elevation 91",
        2,
        "--elevation is 91; use a number",
    ),
    "unknown device": (
        "process rec.h5 -o out.h5 --device tpu",
        2,
        "'tpu' is not one of 'auto', 'cpu', 'cuda', 'numpy'",
    ),
    "unknown method": ("process rec.h5 -o out.h5 --method quick", 2, "'quick' is not one of 'fast', 'paper'"),
    "no threads": ("process rec.h5 -o out.h5 --threads 0", 2, "--threads is 0; use a whole number from 1"),
    "unknown key": (
        "process rec.h5 -o out.h5 --settings key.toml",
        1,
        "key.toml, line 2, air: unknown key `tempreature_c`",
    ),
    "not TOML": ("process rec.h5 -o out.h5 --settings nan.csv", 1, "nan.csv is not TOML; choose a settings file"),
    "missing settings": ("process rec.h5 -o out.h5 --settings none.toml", 1, "none.toml: No such file"),
    "other length": ("process rec.h5 -o out.h5 --settings long.toml", 1, "use the settings that it was recorded with"),
    # outputs
    "output exists": (
        "process rec.h5 -o img.h5",
        1,
        "output img.h5 exists; choose another name, or replace the file",
    ),
    "output is a folder": (
        "process rec.h5 -o folder --force",
        1,
        "output folder is a folder; choose the name of a file",
    ),
    "no such folder": ("process rec.h5 -o none/out.h5", 1, "output none/out.h5: folder none does not exist; create it"),
    "output is the input": ("process rec.h5 -o rec.h5 --force", 1, "output rec.h5 is the input itself; choose"),
    # views of files
    "no such measurement": ("plot img.h5 -o out.png -m 7", 1, "--measurement is 7; use a whole number from 0 to 0"),
    "negative measurement": (
        "peaks img.h5 -m -1",
        2,
        "Invalid value for '--measurement' / '-m': -1 is not in the range x>=0",
    ),
    "no peaks": ("peaks img.h5 --top 0", 2, "--top is 0; use a whole number of at least 1"),
    "peaks above": ("peaks img.h5 --min-level 3", 2, "--min-level is 3; use a number from -1000 to 0"),
    "nothing at that level": ("compare truth.h5 --min-level 3", 2, "--min-level is 3; use a number from -1000 to 0"),
    "this folder": ("plot .", 1, ". is a folder; choose a recording, an energyscape file or a file of acoustic maps"),
    "root": (
        "plot / --kind array",
        1,
        "/ is a folder; choose a recording, an energyscape file or a file of acoustic maps",
    ),
    "a folder": (
        "plot folder",
        1,
        "folder is a folder; choose a recording, an energyscape file or a file of acoustic maps",
    ),
    "picture format": (
        "plot img.h5 -o out.bmp",
        1,
        "picture out.bmp ends in '.bmp'; choose a name that ends in .pdf",
    ),
    "dynamic range": ("plot img.h5 -o out.png --dynamic-range -5", 2, "--dynamic-range is -5; use a number above 0"),
    # sensors and ground truth
    "which sensor": (
        "plot two.h5 -o out.png",
        1,
        "two.h5 contains 2 sensors; choose one of left, right (--sensor)",
    ),
    "no such sensor to process": ("process rec.h5 -o out.h5 --sensor x", 1, "has no sensor 'x'; choose one of eRTIS-7"),
    "no such sensor to plot": ("plot two.h5 -o out.png --sensor x", 1, "no sensor 'x'; choose one of left, right"),
    "no such sensor to list": ("peaks two.h5 --sensor x", 1, "two.h5 has no sensor 'x'; choose one of left, right"),
    "no such sensor to compare": ("compare two.h5 --sensor x", 1, "has no sensor 'x'; choose one of left, right"),
    "recording to compare": (
        "compare rec.h5",
        1,
        "rec.h5 is a recording, wanted an energyscape file; process it first",
    ),
    "no truth": (
        "compare img.h5",
        1,
        "img.h5: sensor sensor holds no ground truth; simulate a scene and process that recording",
    ),
    "no truth to list": (
        "peaks img.h5 --truth",
        1,
        "img.h5: sensor sensor holds no ground truth; simulate a scene",
    ),
    "part of the truth": (
        "peaks truth.h5 --truth --top 3",
        2,
        "--top would omit reflectors that --truth compares; choose one of them; see 'ertis peaks --help'",
    ),
    # usage
    "unknown command": ("prozess", 2, "No such command 'prozess'"),
    "unknown option": ("info rec.h5 --jsno", 2, "No such option"),
    "no command": ("--verbose", 2, "No such option"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with all files that the cases name, valid and invalid."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "folder").mkdir()
    for name, n_bytes in {"good": N_BYTES, "empty": 0, "odd": N_BYTES - 1, "cut": N_BYTES - 4}.items():
        (folder / f"{name}.bin").write_bytes(bytes(n_bytes))
    (folder / "empty.h5").touch()
    (folder / "empty.csv").touch()
    (folder / "nan.csv").write_text("0, 0\n1, nan\n2, 0\n")
    (folder / "key.toml").write_text("[air]\ntempreature_c = 3.0\n")
    (folder / "long.toml").write_text("[recording]\nn_samples = 163840\n")
    write_recording(folder / "rec.h5", noise())
    write_energyscapes(folder / "img.h5", [image()])
    truth = GroundTruth(scene="", seed=1, reflectors=((),))
    write_energyscapes(folder / "truth.h5", [image()], truth={"sensor": truth})
    write_energyscapes(folder / "two.h5", [image().replace(stamp=Stamp(sensor=name)) for name in ("left", "right")])
    for name in ("cut", "newer", "damaged", "nan"):
        shutil.copy(folder / "rec.h5", folder / f"{name}.h5")
    os.truncate(folder / "cut.h5", 100_000)
    with h5py.File(folder / "other.h5", "w") as file:
        file["x"] = 1
    with h5py.File(folder / "newer.h5", "r+") as file:
        file.attrs["ertis_format_version"] = 9
    with h5py.File(folder / "damaged.h5", "r+") as file:
        file["sensors/eRTIS-7/pdm"][1, 5] ^= 1
    with h5py.File(folder / "nan.h5", "r+") as file:
        file["sensors/eRTIS-7/calibration_gain"][3] = np.nan
    return folder


@pytest.mark.parametrize("name", CASES)
def test_invalid_command_prints_one_line_and_writes_nothing(folder, monkeypatch, name):
    command, code, message = CASES[name]
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    done = CliRunner().invoke(cli, command.split())
    assert done.exit_code == code, done.output
    assert done.stdout == ""
    stated = done.stderr
    for note in (options.COMPILING, options.PREPARING):  # a slow machine prints these notes first
        stated = stated.removeprefix(f"{note}\n")
    assert stated.startswith("ertis: error: ")
    assert stated.count("\n") == 1
    assert message in stated
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_process_reports_a_read_only_folder(tmp_path, folder):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o555)
    done = CliRunner().invoke(cli, ["process", str(folder / "rec.h5"), "-o", str(tmp_path / "out.h5")])
    assert done.exit_code == 1
    assert "Permission denied" in done.stderr


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="only Linux has folders that root cannot write either")
@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            "process rec.h5 -o /proc/x/",
            "/proc/x: No such file or directory; check that its folder exists, or choose",
        ),
        (
            "process rec.h5 -o /sys/a/",
            "/sys/a: Operation not permitted; check the permissions of the file and its folder, or choose",
        ),
        (
            "process rec.h5 -o /sys/a.h5 --quiet",
            "/sys/a.h5 cannot be written (Permission denied); check the permissions",
        ),
        (
            "plot rec.h5 --kind signals -o /sys/a.png",
            "/sys/a.png: Permission denied; check the permissions of the file and its",
        ),
        ("export img.h5 -o /sys/a.csv", "/sys/a.csv cannot be written (Permission denied); check the permissions"),
    ],
)
def test_unwritable_output_suggests_a_fitting_remedy(folder, monkeypatch, command, message):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("ertis_numba.storage._writer.require_free_space", lambda *_: None)  # /sys has no free space
    done = CliRunner().invoke(cli, command.split())
    assert done.exit_code == 1
    assert done.stderr.startswith(f"ertis: error: {message}"), done.stderr
    assert "space" not in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
@pytest.mark.parametrize("more", [[], ["--json"]])
def test_full_disk_behind_stdout_is_reported_in_one_line(folder, more):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ertis_cli", "info", folder / "rec.h5", *more],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert (done.returncode, done.stderr) == (
        1,
        "ertis: error: the output is full (No space left on device); free some space or write elsewhere\n",
    )


BUG = """
import sys
from ertis_cli import _tables
from ertis_cli.main import main
def fail(*_):
    raise KeyError("gain")
_tables.TextTable.print = fail
sys.argv[1:] = ["reference", "presets"]
main()
"""


@pytest.mark.parametrize("mode", ["", "1"])
def test_unexpected_error_is_one_line_that_blames_no_file_and_a_traceback_in_development_mode(mode):
    done = subprocess.run(
        [sys.executable, "-c", BUG],
        env=os.environ | {"PYTHONDEVMODE": mode},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (1, "")
    if mode:
        assert "Traceback" in done.stderr
    else:
        line = r"ertis: error: unexpected KeyError: 'gain' \(\w+\.py, line \d+\); report this as a bug, .*MODE=1\n"
        assert re.fullmatch(line, done.stderr), done.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
@pytest.mark.parametrize(
    "words",
    [
        "info PIPE",
        "verify PIPE",
        "sensors check PIPE",
        "peaks PIPE",
        "process PIPE -o out.energy.h5",
        "process rec.h5 --settings PIPE -o out.energy.h5",
        "plot PIPE -o out.png",
        "export PIPE -o out.csv",
        "map rec.h5 --poses PIPE -o out.map.h5",
        "odometry PIPE -o out.tum",
        "import signals PIPE -o out.h5 --layout eRTIS_v2 --preset short_25_50",
        "simulate PIPE -o out.h5",
        "view PIPE --save-html out.html",
    ],
)
def test_named_pipe_is_refused_instead_of_waiting_for_a_writer(words, folder, monkeypatch, tmp_path):
    monkeypatch.chdir(folder)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    done = CliRunner().invoke(cli, words.replace("PIPE", str(pipe)).split())
    assert done.exit_code == 1
    assert done.stderr == f"ertis: error: {pipe} is a named pipe; write its content to a file, and use the file\n"


def test_unreadable_file_and_pipe_of_a_shell_get_their_own_remedies(folder, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    ours, theirs = os.pipe()
    os.close(theirs)
    with os.fdopen(ours, "rb"), pytest.raises(DataError, match="is a pipe; write its content to a file, and use that"):
        open_recording(f"/dev/fd/{ours}")
    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(DataError, match="Permission denied; ask its owner for permission to read it"):
        open_recording(folder / "rec.h5")
