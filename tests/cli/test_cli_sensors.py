"""Commands on files with several sensors and with ground truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.frames import Stamp
from ertis_numba.storage import GroundTruth, open_energyscapes, sensor_names, write_energyscapes, write_recording
from tests.analysis.test_compare import LEFT, MIDDLE, RIGHT, ideal, true
from tests.files import line, noise

ERRORS = ("angle_rms_deg", "range_bias_m", "range_rms_m", "level_rms_db", "missed", "spurious")
FAST = ["--range", "0.5:0.9", "--directions", "2d:9"]


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def report(*arguments):
    return json.loads(run(*arguments, "--json").stdout)


@pytest.fixture
def recording(tmp_path):
    """A recording of two sensors with different arrays and a ground truth of one sensor."""
    given = [
        replace(m, stamp=replace(m.stamp, sensor=name))
        for name, settings, count in (("right", line(8, 8), 2), ("left", line(16, 16), 1))
        for m in noise(settings, count)
    ]
    truth = {"right": GroundTruth(scene='name = "two"\n', seed=7, reflectors=((MIDDLE,), (MIDDLE, LEFT)))}
    mounting = {"left": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))}
    return write_recording(tmp_path / "rec.h5", given, truth=truth, mounting=mounting)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Images of two sensors: the first has all reflectors, the second a missed reflector and a ghost."""
    shown = {"front": [ideal(LEFT, MIDDLE), ideal(RIGHT)], "rear": [ideal(LEFT, MIDDLE)]}
    reported = {"front": ((MIDDLE, LEFT), (RIGHT,)), "rear": ((MIDDLE, RIGHT),)}
    return write_energyscapes(
        tmp_path_factory.mktemp("images") / "img.h5",
        [image.replace(stamp=Stamp(sensor=name)) for name, given in shown.items() for image in given],
        truth={name: GroundTruth(scene="", seed=1, reflectors=rows) for name, rows in reported.items()},
    )


def test_process_includes_all_sensors(recording, tmp_path):
    made = report("process", recording, "-o", tmp_path / "img.h5", *FAST)
    assert (made["measurements"], made["device"]) == (3, "cpu")
    assert [(row["sensor"], row["measurements"], row["directions"]) for row in made["sensors"]] == [
        ("right", 2, 9),
        ("left", 1, 9),
    ]
    assert "directions" not in made
    assert sensor_names(tmp_path / "img.h5") == ("right", "left")
    with open_energyscapes(tmp_path / "img.h5", sensor="right") as right:
        assert [[reflector.name for reflector in row] for row in right.truth.reflectors] == [
            ["points[0]"],
            ["points[0]", "points[0]"],
        ]
        assert right.settings.array.layout == "line"
        assert len(right.settings.array.positions_m) == 8
    with open_energyscapes(tmp_path / "img.h5", sensor="left") as left:
        assert left.truth is None
        assert len(left.settings.array.positions_m) == 16


def test_process_selects_one_sensor(recording, tmp_path):
    run("process", recording, "-o", tmp_path / "both.h5", *FAST)
    made = report("process", recording, "-o", tmp_path / "one.h5", "--sensor", "left", *FAST)
    assert (made["measurements"], made["directions"], made["sensors"][0]["sensor"]) == (1, 9, "left")
    assert sensor_names(tmp_path / "one.h5") == ("left",)
    with open_energyscapes(tmp_path / "both.h5", sensor="left") as both, open_energyscapes(tmp_path / "one.h5") as one:
        assert np.array_equal(both[0].amplitude, one[0].amplitude)


def test_process_prints_a_line_for_each_sensor(recording, tmp_path):
    lines = run("process", recording, "-o", tmp_path / "img.h5", *FAST).stderr.splitlines()
    reported = [text for text in lines if "img.h5" in text]
    assert "2 measurements of right, 9 directions" in reported[0]
    assert "1 measurement of left, 9 directions" in reported[1]


def test_process_rejects_invalid_range_without_writing(recording, tmp_path):
    done = run("process", recording, "-o", tmp_path / "img.h5", "--range", "1:50", code=1)
    assert "--range ends at 50 m" in done.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_info_has_a_section_for_each_sensor(recording, images):
    held = report("info", recording)
    assert (held["kind"], [row["sensor"] for row in held["sensors"]]) == ("recording", ["right", "left"])
    assert [row["simulated"] for row in held["sensors"]] == [True, False]
    assert [row["microphones"] for row in held["sensors"]] == [8, 16]
    assert held["sensors"][1]["translation_m"] == [1.0, 0.0, 0.0]
    assert "sensor" not in held
    sections = run("info", recording).stdout.split("\n\n")
    assert len(sections) == 3
    assert ["sensor", "left"] in [line.split() for line in sections[2].splitlines()]
    assert [row["measurements"] for row in report("info", images)["sensors"]] == [2, 1]


def test_info_of_one_sensor_is_flat_too(tmp_path):
    held = report("info", write_recording(tmp_path / "rec.h5", noise()))
    assert held["measurements"] == 3
    assert held.items() >= held["sensors"][0].items()


def test_plot_selects_sensor_and_measurement(images, recording, tmp_path):
    made = report("plot", images, "-o", tmp_path / "a.png", "--sensor", "front", "-m", 1)
    assert (made["sensor"], made["measurement"]) == ("front", 1)
    run("plot", recording, "-o", tmp_path / "b.png", "--sensor", "left")
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")


def test_peaks_lists_all_sensors_or_a_selected_one(images):
    found = report("peaks", images)["peaks"]
    assert [(peak["sensor"], peak["measurement"]) for peak in found] == [
        ("front", 0),
        ("front", 0),
        ("front", 1),
        ("rear", 0),
        ("rear", 0),
    ]
    assert {peak["sensor"] for peak in report("peaks", images, "--sensor", "rear")["peaks"]} == {"rear"}
    lines = run("peaks", images, "-m", 0).stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["sensor", "front", "front", "rear", "rear"]


def test_peaks_truth_reports_errors_and_missed_reflectors(images):
    held = report("peaks", images, "--truth")
    assert [peak["truth"]["name"] if peak["truth"] else None for peak in held["peaks"]] == ["points[0]"] * 4 + [None]
    assert [peak["spurious"] for peak in held["peaks"]] == [False] * 4 + [True]
    first = held["peaks"][0]
    assert first["truth"] == {
        "name": "points[0]",
        "azimuth_deg": 3.3,
        "elevation_deg": 0.0,
        "range_m": 1.3,
        "level_db": 0.0,
        "velocity_m_s": [0.0, 0.0, 0.0],
    }
    assert first["error"]["angle_deg"] == pytest.approx(abs(first["azimuth_deg"] - 3.3), abs=1e-4)
    assert held["peaks"][-1]["error"] is None
    assert [(row["sensor"], row["measurement"], row["azimuth_deg"]) for row in held["missed"]] == [("rear", 0, 55.5)]
    assert report("peaks", images, "--truth", "-m", 0, "--sensor", "front")["missed"] == []


def test_peaks_truth_table_has_error_columns(images):
    head, *lines = run("peaks", images, "--truth", "--sensor", "rear").stdout.splitlines()
    assert head.split()[-4:] == ["angle_error_deg", "range_error_m", "level_error_db", "reflector"]
    cells = [line.split() for line in lines]
    assert cells[0][:4] == ["rear", "0", "+3.30", "+0.00"]
    assert cells[0][-1] == "points[0]"
    assert cells[1][2:] == ["+55.50", "+0.00", "1.450", "-4.0", "missed", "-", "-", "points[0]"]
    assert cells[2][6:] == ["spurious", "-", "-", "-"]
    assert len({len(line.rsplit(None, 1)[0].rstrip()) for line in lines[1:]}) == 1  # columns are aligned


def test_compare_reports_all_sensors(images):
    held = report("compare", images)
    assert [(row["sensor"], row["measurements"], row["matched"]) for row in held["sensors"]] == [
        ("front", 2, 3),
        ("rear", 1, 1),
    ]
    assert [(row["missed"], row["spurious"]) for row in held["sensors"]] == [(0, 0), (1, 1)]
    assert (held["measurements"], held["matched"], held["missed"], held["spurious"]) == (3, 4, 1, 1)
    for row in (held, *held["sensors"]):
        assert set(ERRORS) <= set(row)
        assert row["angle_rms_deg"] < 0.5
        assert abs(row["range_bias_m"]) <= row["range_rms_m"] < 1e-3


def test_compare_selects_sensor_and_min_level(images):
    held = report("compare", images, "--sensor", "rear", "--min-level", -3)
    assert (len(held["sensors"]), held["matched"], held["missed"], held["spurious"]) == (1, 1, 0, 0)


def test_compare_prints_an_aligned_table(images):
    head, *lines = run("compare", images).stdout.splitlines()
    assert head.split()[0] == "sensor"
    assert set(ERRORS) <= set(head.split())
    assert [line.split()[0] for line in lines] == ["front", "rear", "all"]
    assert len({len(line) for line in (head, *lines)}) == 1


def test_compare_without_matches_has_no_errors(tmp_path):
    path = write_energyscapes(
        tmp_path / "img.h5",
        [ideal()],
        truth={"sensor": GroundTruth(scene="", seed=1, reflectors=((true(0, 1.0),),))},
    )
    held = report("compare", path)
    assert [held[name] for name in ERRORS] == [None, None, None, None, 1, 0]
    assert run("compare", path).stdout.splitlines()[-1].split() == ["all", "1", "0", "1", "0", "-", "-", "-", "-"]
