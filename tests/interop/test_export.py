"""``ertis export``: selection, formats, complete files or none, and the page about it."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli import export as command
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.interop import EXPORT_FORMATS, FORMATS, TOPICS, Drive, choose_format, export, output_files
from ertis_numba.settings import Air
from ertis_numba.storage import write_energyscapes, write_recording
from tests.files import SMALL, echoes, image, noise
from tests.pages import page, run_code_here

pytestmark = pytest.mark.usefixtures("sound_unchecked")

ROOT = Path(__file__).parents[2]
PAGE = page("export")
MOUNTED = {"left": ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), "right": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))}


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["export", *map(str, arguments)])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Recordings of two sensors and of one sensor, and energyscape files."""
    folder = tmp_path_factory.mktemp("files")
    both = [
        Measurement(given.data, SMALL, Stamp(sensor=sensor, sequence=number))
        for sensor in ("left", "right")
        for number, given in enumerate(echoes())
    ]
    write_recording(folder / "both.h5", both, mounting=MOUNTED)
    write_recording(folder / "rec.h5", noise())
    pipeline = ertis.Pipeline(SMALL)
    images = [pipeline.process(given) for given in both]
    write_energyscapes(folder / "both.energy.h5", images)
    write_energyscapes(folder / "img.h5", [image(seed=seed) for seed in range(4)])
    return folder


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_export_processes_a_recording_with_its_settings(files, tmp_path):
    run(files / "rec.h5", "-o", tmp_path / "a.npz")
    with ertis.open_recording(files / "rec.h5") as recording, np.load(tmp_path / "a.npz") as data:
        pipeline = ertis.Pipeline(recording.settings)
        assert np.array_equal(data["amplitude"], [pipeline.process(each).amplitude for each in recording])
        assert data["sequence"].tolist() == [10, 11, 12]


@pytest.mark.parametrize(("places", "chosen"), [("2", [2]), ("1:2", [1, 2]), ("0:0", [0]), (None, [0, 1, 2, 3])])
def test_export_selects_measurements(files, tmp_path, places, chosen):
    run(files / "img.h5", "-o", tmp_path / "a.npz", *(() if places is None else ("--measurement", places)))
    with np.load(tmp_path / "a.npz") as data:
        assert np.array_equal(data["amplitude"], [image(seed=seed).amplitude for seed in chosen])


def test_export_writes_points_in_the_platform_frame(files, tmp_path):
    run(files / "both.h5", "-o", tmp_path / "a.csv", "--top", 3)
    run(files / "both.energy.h5", "-o", tmp_path / "b.csv", "--sensor", "right", "--top", 3)
    both, right = rows(tmp_path / "a.csv"), rows(tmp_path / "b.csv")
    assert {row["sensor"] for row in both} == {"left", "right"}
    turned = [row for row in both if row["sensor"] == "right"]
    assert len(turned) == len(right) == 9
    for there, here in zip(turned, right, strict=True):  # half a turn about z, and one metre back
        assert float(there["x_m"]) == pytest.approx(-1 - float(here["x_m"]), abs=1e-6)
        assert float(there["y_m"]) == pytest.approx(-float(here["y_m"]), abs=1e-6)
        assert there["amplitude"] == here["amplitude"]


def test_export_reports_json_and_a_summary(files, tmp_path):
    done = run(files / "both.h5", "-o", tmp_path / "a.csv", "--json")
    assert json.loads(done.stdout) == {
        "output": str(tmp_path / "a.csv"),
        "format": "csv",
        "files": [str(tmp_path / "a.csv")],
        "sensors": ["left", "right"],
        "measurements": 6,
    }
    assert "6 measurements of 2 sensors as csv" in done.stderr
    assert run(files / "rec.h5", "-o", tmp_path / "b.csv", "--quiet").stderr == ""


def test_export_leaves_out_measurements_without_a_call(tmp_path):
    passive = [
        Measurement(given.data, SMALL, Stamp(sequence=number, behaviour="active" if number == 1 else "passive"))
        for number, given in enumerate(noise())
    ]
    write_recording(tmp_path / "rec.h5", passive)
    done = run(tmp_path / "rec.h5", "-o", tmp_path / "a.npz", "--json")
    assert "note: 2 measurements without a call left out; 'ertis acoustic' makes maps of their sound" in done.stderr
    assert json.loads(done.stdout[done.stdout.index("{") :])["measurements"] == 1
    with np.load(tmp_path / "a.npz") as data:
        assert data["sequence"].tolist() == [1]
    done = run(tmp_path / "rec.h5", "-o", tmp_path / "b.npz", "--measurement", "2", code=1)
    assert "all chosen measurements of sensor sensor are passive and have no echoes" in done.stderr
    assert not (tmp_path / "b.npz").exists()


def test_export_format_follows_suffix_or_option(files, tmp_path):
    run(files / "img.h5", "-o", tmp_path / "CLOUD.PLY")
    assert (tmp_path / "CLOUD.PLY").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    run(files / "img.h5", "-o", tmp_path / "cloud.txt", "--format", "pcd", "--ascii")
    assert "\nDATA ascii\n" in (tmp_path / "cloud.txt").read_text()
    run(files / "rec.h5", "-o", tmp_path / "signals.h5", "-m", 1)
    assert {path.name for path in tmp_path.iterdir()} == {"CLOUD.PLY", "cloud.txt", "signals.h5", "signals.xml"}
    assert [choose_format("x.h5"), choose_format("x.csv"), choose_format("x.csv", "npz")] == ["acoular", "csv", "npz"]
    assert [path.name for path in output_files("x.h5", "acoular")] == ["x.h5", "x.xml"]


def test_export_accepts_changing_air_except_in_npz(tmp_path):
    """Each image uses the air of its measurement, but an NPZ file has only one range axis."""
    words = echoes(count=1)[0].data
    warm = SMALL.replace(air=Air(temperature_c=35.0))
    given = [Measurement(words, settings, Stamp(sequence=n)) for n, settings in enumerate((SMALL, warm, warm))]
    write_recording(tmp_path / "rec.h5", given)
    run(tmp_path / "rec.h5", "-o", tmp_path / "a.csv", "--top", 1)
    x_m = [float(row["x_m"]) for row in rows(tmp_path / "a.csv")]
    assert x_m[1] == x_m[2]
    done = run(tmp_path / "rec.h5", "-o", tmp_path / "a.npz", code=1)
    assert "has another range_m than the first, for example because of other air" in done.stderr
    run(tmp_path / "rec.h5", "-o", tmp_path / "b.npz", "-m", "1:2")


CASES = {
    "no ending": (
        "rec.h5 -o a.xyz",
        1,
        "choose a name that ends in .mcap, .ply, .pcd, .csv, .npz, .h5, .mat, .tum, .wav",
    ),
    "no output": ("rec.h5", 2, "Missing option '--output'"),
    "no format": ("rec.h5 -o a --format las", 2, "'las' is not one of 'mcap', 'ply'"),
    "no such place": ("img.h5 -o a.npz -m 4", 1, "--measurement is 4; use a whole number from 0 to 3"),
    "places backwards": ("img.h5 -o a.npz -m 2:1", 2, "--measurement runs from 2 to 1; use the smaller number first"),
    "no places": ("img.h5 -o a.npz -m 1:x", 2, "'1:x' is not a measurement; use one number, or two as in 2:5"),
    "unknown mounting": (
        "both.energy.h5 -o a.ply",
        1,
        "choose one sensor (--sensor), or add their mountings (--mounting)",
    ),
    "several sensors": ("both.h5 -o a.npz", 1, "sensors left and right cannot share the axes of one npz"),
    "several signals": ("rec.h5 -o a.h5", 1, "more than one measurement was passed; choose one measurement"),
    "no signals": ("img.h5 -o a.h5 -m 0", 1, "img.h5 is an energyscape file, wanted a recording; use the recording"),
    "topics of a cloud": (
        "img.h5 -o a.ply --topic points",
        2,
        "option --topic is given, but format 'ply' does not have it; leave it out, or write mcap",
    ),
    "text of a table": ("img.h5 -o a.csv --ascii", 2, "option --ascii is given, but format 'csv' does not have it"),
    "points of images": (
        "img.h5 -o a.npz --top -3",
        2,
        "option --top is given, but format 'npz' does not have it; leave it out, or write mcap, ply, pcd or csv",
    ),
    "levels of signals": ("rec.h5 -o a.h5 -m 0 --min-level -9", 2, "option --min-level is given, but format"),
    "no points": ("img.h5 -o a.csv --top 0", 2, "--top is 0; use a whole number of at least 1"),
    "over the input": ("rec.h5 -o rec.h5 --force -m 0", 1, "output rec.h5 is the input itself; choose another name"),
    "exists": ("img.h5 -o both.h5 --format csv", 1, "output both.h5 exists; choose another name, or replace the file"),
    "no folder": (
        "img.h5 -o none/a.csv",
        1,
        "output none/a.csv: folder none does not exist; create it or choose another",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_invalid_export_prints_one_line_and_writes_nothing(files, monkeypatch, name):
    arguments, code, message = CASES[name]
    monkeypatch.chdir(files)
    before = {path: path.stat().st_mtime_ns for path in files.iterdir()}
    done = run(*arguments.split(), "--quiet", code=code)  # a slow machine would print a note about preparation
    assert done.stdout == ""
    assert done.stderr.startswith("ertis: error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert {path: path.stat().st_mtime_ns for path in files.iterdir()} == before


DRIVE = Drive(
    poses=ertis.Trajectory([0, 2 * 10**18], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1]] * 2),
    odometry=ertis.Trajectory([0, 2 * 10**18], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1]] * 2),
)


def valid(kind):
    """Return the items and the options that an export of this format needs."""
    if kind == "batslam":
        return noise(count=2), {"drive": DRIVE}
    return ([noise(count=1)[0]] if kind == "acoular" else [image()]), {}


GIVEN = {"drive": DRIVE, "mounting": MOUNTED, "topics": TOPICS, "top": 5, "min_level_db": -9.0, "text": True}


@pytest.mark.parametrize("option", GIVEN)
@pytest.mark.parametrize("kind", FORMATS)
def test_export_accepts_only_options_of_the_format(tmp_path, kind, option):
    """Options that a format lacks are rejected rather than ignored."""
    target = tmp_path / f"a{FORMATS[kind].suffix}"
    items, needed = valid(kind)
    if option in FORMATS[kind].options:
        export(target, items, **needed | {option: GIVEN[option]})
        return
    with pytest.raises(ArgumentError, match=f"option {option!r} is given, but format {kind!r} does not have it; leave"):
        export(target, items, **needed | {option: GIVEN[option]})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", FORMATS)
def test_failed_export_keeps_the_existing_file(tmp_path, kind):
    target, *others = output_files(tmp_path / f"a{FORMATS[kind].suffix}", kind)
    for path in (target, *others):
        path.write_text("mine")

    items, needed = valid(kind)

    def broken():
        yield from items if kind in {"acoular", "batslam"} else [image(), image(seed=2)]
        raise DataError("the source broke off; copy it again")

    with pytest.raises(DataError, match="broke off"):
        export(target, broken(), overwrite=True, **needed)
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}
    assert len(list(tmp_path.iterdir())) == 1 + len(others)


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind != "acoular"])
def test_export_writers_raise_on_a_full_disk(tmp_path, kind):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")

    class Full(type(Path())):
        def open(self, *arguments, **options):
            return Path("/dev/full").open(*arguments, **options)

    from ertis_numba.interop import _batslam, _mcap, _npz, _point_files, _points  # noqa: PLC0415  loads optional libraries

    part = Full(tmp_path / "a.part")
    find = PointFinder(top=256, min_level_db=-60.0)
    images = [image(seed=seed) for seed in range(30)]
    table = _points.PointTable.from_images(images, find, {})
    write = {
        "mcap": lambda: _mcap.write_mcap(part, images, find, {}, topics=TOPICS),
        "batslam": lambda: _batslam.write_batslam(part, noise(count=2), DRIVE, {}),
        "npz": lambda: _npz.write_npz(Path("/dev/full"), images, None),
        "csv": lambda: _point_files.write_csv(part, table),
        "ply": lambda: _point_files.write_ply(part, table, text=True),
        "pcd": lambda: _point_files.write_pcd(part, table, text=False),
    }[kind]
    with pytest.raises(OSError, match="No space left on device"):
        write()


def test_export_disk_errors_name_the_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ertis_numba.interop._npz.write_npz", full)
    with pytest.raises(DataError, match=r"a.npz cannot be written \(No space left on device\); free some space"):
        export(tmp_path / "a.npz", [image()])
    assert list(tmp_path.iterdir()) == []


def test_export_rejects_measurements_and_unknown_formats(tmp_path):
    with pytest.raises(ArgumentError, match="a measurement is given, but energyscapes are needed; process it first"):
        export(tmp_path / "a.ply", noise())
    with pytest.raises(ArgumentError, match="format 'las' is unknown"):
        export(tmp_path / "a.ply", [image()], file_format="las")


def test_export_command_lists_formats_and_topics_of_the_library():
    options = {option.name: option.type for option in command.export.params}
    assert tuple(options["file_format"].choices) == tuple(EXPORT_FORMATS)
    assert tuple(options["topics"].choices) == TOPICS


def test_export_page_lists_fields_of_each_format():
    table = PAGE[PAGE.index("| format |") :].split("\n\n", 1)[0].splitlines()[2:]
    reported = {}
    for line in table:
        name, ending, held, _ = (cell.strip() for cell in line.strip("|").split("|"))
        reported[name.strip("`")] = (ending.strip("`"), tuple(re.findall(r"`(\w+)`", held)))
    assert reported == {name: (each.suffix, each.fields) for name, each in FORMATS.items()}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the files that the page names."""
    (tmp_path / "data").symlink_to(ROOT / "data")
    (tmp_path / "FOLDER").mkdir()
    for number in (3, 4):
        (tmp_path / "FOLDER" / f"measurement_{number}.bin").write_bytes(bytes(4 * 65_536))
    settings = {"microphoneSamples": 65_536, "callMinimumFrequency": 25_000, "callMaximumFrequency": 50_000}
    (tmp_path / "FOLDER" / "recording.json").write_text(json.dumps(settings))
    (tmp_path / "FOLDER" / "processing.json").write_text(json.dumps({"microphoneLayout": "eRTIS_v3D1", "maxRange": 1}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_export_page_commands_and_code_run(place):
    for words in re.findall(r"^\$ ertis (.*)$", PAGE, re.MULTILINE):
        done = CliRunner().invoke(cli, words.split())
        assert done.exit_code == 0, (words, done.stderr, done.exception)
    made = {path.name for path in place.iterdir()} - {"data", "FOLDER"}
    assert made == {
        *("REC.mcap", "CLOUD.ply", "CLOUD.pcd", "POINTS.csv", "IMG.npz", "SIGNALS.h5", "SIGNALS.xml", "REC.h5"),
        *("SOUND.wav", "SHIFTED.wav", "reflectors.h5", "reflectors.toml"),
    }
    with ertis.open_recording("REC.h5") as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == [3, 4]
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    assert run_code_here(place, code).splitlines() == ["(1, 181, 1178) sensor", "{'time': 1, 'sample': 163840}"]
