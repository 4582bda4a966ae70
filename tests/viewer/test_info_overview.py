"""``ertis info`` of several files and of folders: one line per file."""

import json

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.storage import write_energyscapes, write_recording
from tests.files import SMALL, image, noise

DAY_NS = 86_400 * 10**9


@pytest.fixture
def folder(tmp_path):
    """Two recordings a day apart, a file of images in a folder below, and two files without measurements."""
    words = noise()[0].data
    for day, name in enumerate(["rec10.h5", "rec9.h5"]):
        stamps = [Stamp(sequence=index, timestamp_ns=(20_000 + day) * DAY_NS + index * 10**9) for index in range(3)]
        write_recording(tmp_path / name, [Measurement(words, SMALL, stamp) for stamp in stamps])
    (tmp_path / "below").mkdir()
    write_energyscapes(tmp_path / "below" / "images.h5", [image()])
    (tmp_path / "text.h5").write_text("none", "utf-8")
    (tmp_path / "note.txt").write_text("none", "utf-8")
    return tmp_path


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["info", *map(str, arguments)])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def test_folder_is_listed_with_one_line_per_file_in_natural_order(folder):
    done = run(folder, code=1)
    head, *rows = (line.split() for line in done.stdout.splitlines())
    assert head == ["file", "kind", "sensors", "content", "first", "last", "MB"]
    assert [row[0].rpartition("/")[2] for row in rows] == ["images.h5", "rec9.h5", "rec10.h5"]
    assert rows[1][1:5] == ["recording", "sensor", "3", "measurements"]
    assert rows[1][5:] == ["2024-10-05", "00:00:00", "2024-10-05", "00:00:02", "0.6"]
    assert rows[2][5:7] == ["2024-10-04", "00:00:00"]
    assert "text.h5 is not an HDF5 file" in done.stderr


def test_files_that_can_be_read_end_with_exit_code_0(folder):
    assert len(run(folder / "rec9.h5", folder / "below").stdout.splitlines()) == 3


def test_json_lists_the_reports_of_single_files(folder):
    files = json.loads(run(folder / "rec9.h5", folder / "text.h5", "--json", code=1).stdout)["files"]
    alone = json.loads(run(folder / "rec9.h5", "--json").stdout)
    assert files[0]["sensors"] == alone["sensors"]
    assert files[1]["file"] == str(folder / "text.h5")
    assert "not an HDF5 file" in files[1]["error"]


def test_folder_without_files_is_refused(tmp_path):
    assert "no file in this folder ends in .h5; choose a folder" in run(tmp_path, code=1).stderr


def test_health_needs_one_recording(folder):
    for several in ([folder], [folder / "rec9.h5", folder / "rec10.h5"]):
        assert "--health examines one recording; choose one file" in run(*several, "--health", code=2).stderr


def test_name_with_a_line_feed_is_escaped(tmp_path):
    (tmp_path / "a\nb.h5").touch()
    write_recording(tmp_path / "c\nd.h5", noise())
    done = run(tmp_path, code=1)
    assert r"a\nb.h5" in done.stderr
    assert r"c\nd.h5" in done.stdout
