"""``ertis sensors check``: verdict on recordings of healthy and faulty sensors, JSON, exit codes and the HTML page."""

import dataclasses
import functools
import html.parser
import json
import re

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.analysis.health import Finding, health, limits
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.calibration import OtherLayoutError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import load_layout
from ertis_numba.sensor_check import ArrayFinding, check_recording, write_page
from ertis_numba.sensor_check.clock import MAX_DRIFT_PPM
from ertis_numba.sensor_check.items import of_calibration
from ertis_numba.sensor_check.microphone_faults import channels_in_words
from ertis_numba.sensor_check.residuals import calibration_residuals
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation import Electronics, Point
from ertis_numba.storage import write_energyscapes, write_recording
from tests import files
from tests.health_recordings import BY_HAND, DATA, REAL, real, rendered, sound, with_bits
from tests.pages import path_of, python_in, run_code_here
from tests.scenes import SENSOR
from tests.sensor_check.test_sensor_clock import stamp


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["sensors", "check", *(str(argument) for argument in arguments)])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done


def numbered(measurement, number, behaviour="active"):
    """A measurement with its stamp, and with a bit that tells it from others, because sound never repeats itself."""
    words = measurement.data.copy()
    words[number] ^= 1
    return dataclasses.replace(measurement, data=words, stamp=dataclasses.replace(stamp(number), behaviour=behaviour))


def stored(path, *measurements, **options):
    """Write measurements with regular stamps."""
    return write_recording(path, [numbered(each, number) for number, each in enumerate(measurements)], **options)


def verdict_of(path):
    """Last line of the command, without the folder; the exit code must agree."""
    done = CliRunner().invoke(cli, ["sensors", "check", str(path)])
    verdict = done.stdout.splitlines()[-1].replace(f"{path.parent}/", "")
    assert done.exit_code == (1 if re.search(r": \d+ faults?: ", verdict) else 0), (done.stderr, done.exception)
    return verdict


def results(checked, sensor=0):
    return {item.check: item.result for item in checked.sensors[sensor].items}


PLANE = SENSOR.replace(array=Array(), recording=Recording(n_samples=65_536), electronics=Electronics(noise_dbfs=-45.0))


@functools.cache
def plane_array():
    """A measurement of an array of 32 microphones, with one echo from the side."""
    return rendered(PLANE, Point(azimuth_deg=25, elevation_deg=10, range_m=0.9, strength_db=-5))


# Verdicts on recordings.


def test_healthy_recordings_are_fit_for_use(tmp_path):
    for name in ("reflectors", "line"):
        checked = check_recording(DATA / f"{name}.h5")
        assert checked.is_fit
        assert "fault" not in results(checked).values()
    checked = check_recording(stored(tmp_path / "a.h5", real(), real(), real()))
    shown = "microphones, noise floor, samples, measurements, timing, call"
    start = f"{tmp_path / 'a.h5'}: no fault in {shown}; not known: clock drift, calibration; "
    assert checked.verdict.startswith(f"{start}not observable: ")
    assert results(checked) == {
        "microphones": "ok",
        "noise floor": "ok",
        "samples": "ok",
        "measurements": "ok",
        "timing": "ok",
        "clock drift": "not known",
        "call": "ok",
        "calibration": "not known",
    }


def passive(path, *measurements, active=()):
    """Write measurements without a call, after others with a call."""
    given = [
        numbered(each, number, behaviour)
        for number, (each, behaviour) in enumerate(
            [*((each, "active") for each in active), *((each, "passive") for each in measurements)]
        )
    ]
    return write_recording(path, given)


@functools.cache
def silence():
    """A measurement of 32 microphones that hear only their own noise."""
    return rendered(PLANE.replace(emitter=PLANE.emitter.replace(silent=True)))


def test_recording_without_a_call_is_examined_without_its_echoes(tmp_path):
    path = passive(tmp_path / "a.h5", silence(), silence(), silence())
    checked = check_recording(path)
    assert checked.verdict == (
        f"{path}: no fault in microphones, noise floor, samples, measurements, timing; not known: clock drift, call, "
        "calibration; "
        "not observable: polarity of channels, order of channels, delay of channels, scale of the positions, "
        "mirrored or turned positions, shift of the record (record with calls)"
    )
    details = {item.check: item.detail for item in checked.sensors[0].items}
    assert details["call"] == details["calibration"] == "no call was emitted"
    assert "dead microphones: no sound exceeds the noise" in details["microphones"]
    assert "not observable: polarity of channels, order of channels, delay of channels" in details["microphones"]
    assert "including the sound of sources; the dynamic range needs a call" in details["noise floor"]
    assert checked.sensors[0].calibration is checked.sensors[0].call is None
    assert "3 measurements, 3 of them without a call, 3 examined" in run(path).stdout
    assert json.loads(run(path, "--json").stdout)["sensors"][0]["passive"] == 3
    page = tmp_path / "page.html"
    run(path, "--report", page)
    assert "without a call: 3" in page.read_text()
    assert "Matched-filter output" not in page.read_text()
    # The same sound with a call is a fault, because an echo is missing.
    assert not check_recording(stored(tmp_path / "b.h5", silence())).is_fit


@pytest.mark.parametrize("name", ["stuck at 1", "saturated", "offset"])
def test_faulty_channel_is_found_without_a_call(tmp_path, name):
    checked = check_recording(passive(tmp_path / "a.h5", BY_HAND[name]()))
    assert [fault.check for fault in checked.faults] == ["microphones"]
    assert "channel 3" in checked.faults[0].text


def test_measurements_with_a_call_are_preferred(tmp_path):
    path = passive(tmp_path / "a.h5", silence(), silence(), active=[plane_array()] * 2)
    checked = check_recording(path)
    assert checked.is_fit
    assert checked.sensors[0].examined == (0, 1)
    assert checked.sensors[0].n_passive == 2
    assert (results(checked)["call"], results(checked)["calibration"]) == ("ok", "ok")


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("dead", "channel 3 is dead and has white bits, as without a microphone"),
        ("saturated", "channel 3 is saturated and dead"),
        ("stuck at 1", "channel 3 is stuck at 1"),
        ("offset", "channel 3 is dead and noisy and has an offset and an idle tone"),
    ],
)
def test_faulty_channel_is_named_with_its_remedy(tmp_path, name, fault):
    path = stored(tmp_path / "a.h5", BY_HAND[name]())
    assert verdict_of(path) == f"a.h5: 1 fault: {fault}. Remedy: exclude channel 3 (--without 3)"
    assert run(path, "--without", "3").stdout.splitlines()[-1].startswith(f"{path}: no fault in ")


def test_channels_with_equal_faults_are_one_fault(tmp_path):
    silent = with_bits(with_bits(BY_HAND["stuck at 0"](), 5, np.zeros(65_536)), 6, np.ones(65_536))
    path = stored(tmp_path / "a.h5", silent)
    assert verdict_of(path) == (
        "a.h5: 2 faults: channels 3 and 5 are stuck at 0; channel 6 is stuck at 1. "
        "Remedy: exclude channels 3, 5 and 6 (--without 3,5,6)"
    )


@pytest.mark.parametrize(
    ("channels", "text"),
    [
        ((4,), "channel 4"),
        ((4, 5), "channels 4 and 5"),
        ((0, 1, 2, 3, 7, 9, 10), "channels 0 to 3, 7, 9 and 10"),
        ((3, 5, 6, 7), "channels 3 and 5 to 7"),
    ],
)
def test_channels_are_listed_with_ranges(channels, text):
    assert channels_in_words(channels) == text


def test_saturated_array_asks_for_less_level(tmp_path):
    loud = dataclasses.replace(sound(), data=np.where(np.arange(65_536) // 400 % 2, 255, 0).astype("u1"))
    verdict = verdict_of(stored(tmp_path / "a.h5", loud))
    assert "every channel is saturated" in verdict
    assert "emit less, or move the array away from near objects, and record again" in verdict


def swapped(measurement, first, second):
    words = measurement.data
    differ = ((words >> first) ^ (words >> second)) & 1
    return dataclasses.replace(measurement, data=words ^ ((differ << first) | (differ << second)))


def test_dead_and_swapped_channels_are_reported_together(tmp_path):
    array = plane_array()
    silent = with_bits(swapped(array, 5, 12), 7, np.zeros(65_536))
    path = stored(tmp_path / "a.h5", silent)
    assert verdict_of(path).startswith(
        "a.h5: 2 faults: channels 5 and 12 are swapped; channel 7 is stuck at 0. Remedy: "
    )


def test_silence_is_not_fit_for_use(tmp_path):
    noise = np.random.default_rng(1).integers(0, 2**32, 163_840, dtype="u4")
    verdict = verdict_of(stored(tmp_path / "a.h5", Measurement(noise, REAL, Stamp())))
    assert verdict.startswith(
        "a.h5: 3 faults: faulty microphones cannot be detected (dead microphones: no sound exceeds"
    )
    assert re.search(r"the noise of -19\.\d dBFS is that of random bits; 1 of 1 examined .* has random bits", verdict)
    quiet = rendered(SENSOR.replace(array=Array(), recording=Recording(n_samples=65_536)), Point(range_m=5.9))
    assert "faulty microphones cannot be detected (" in verdict_of(stored(tmp_path / "b.h5", quiet))


def test_lost_words_are_found(tmp_path):
    words = real().data.copy()
    words[60_000:-5] = words[60_005:]
    cut = Measurement(words, REAL, Stamp())
    checked = check_recording(stored(tmp_path / "a.h5", real(), cut))
    assert checked.sensors[0].words.reasons == {1: "splice"}
    assert checked.verdict.endswith(
        "a.h5: 1 fault: 1 of 2 examined measurements has lost or misplaced words, the first at 1. "
        "Remedy: check the link to the sensor, and record again"
    )


def test_missing_measurements_are_a_fault(tmp_path):
    given = [dataclasses.replace(sound(), stamp=stamp(number)) for number in (0, 1, 4, 5)]
    path = write_recording(tmp_path / "a.h5", given)
    assert verdict_of(path).startswith(
        "a.h5: 1 fault: 2 of 6 measurements are missing (not among the measurements given). Remedy: check"
    )


def test_damaged_measurements_are_a_fault_and_the_others_are_examined(tmp_path):
    path = stored(tmp_path / "a.h5", sound(), sound(), sound())
    with h5py.File(path, "r+") as file:
        file["sensors/sensor/pdm"][0, 5] ^= 1
    checked = check_recording(path)
    assert checked.sensors[0].examined == (1, 2)
    assert checked.verdict.endswith(
        "a.h5: 1 fault: 1 of 3 measurements is damaged. Remedy: copy the file again, or record again"
    )


def test_recording_with_damaged_content_is_not_fit(tmp_path):
    path = stored(tmp_path / "a.h5", sound())
    with h5py.File(path, "r+") as file:
        file["sensors/sensor/sequence"][0] = 5
    assert re.fullmatch(
        r"a.h5: 1 fault: the content of sensor sensor has SHA-256 .*the file is damaged\. Remedy: copy it again",
        verdict_of(path),
    )


def test_files_that_cannot_be_read_are_errors(tmp_path):
    whole = stored(tmp_path / "a.h5", sound())
    cut = tmp_path / "cut.h5"
    cut.write_bytes(whole.read_bytes()[:9000])
    image = write_energyscapes(tmp_path / "image.h5", [files.image()])
    absent = tmp_path / "absent.h5"
    done = run(cut, image, absent, whole, "--quiet", code=1)
    errors = done.stderr.splitlines()
    assert [line.split(": ", 2)[:2] for line in errors] == [["ertis", "error"]] * 3
    assert "cut short or damaged" in errors[0]
    assert f"{image} is an energyscape file, wanted a recording; use the recording from which it was made" in errors[1]
    assert f"{absent}: No such file or directory" in errors[2]
    assert done.stdout == ""
    objects = [json.loads(line) for line in run(cut, whole, "--json", code=1).stdout.splitlines()]
    assert [each["fit"] for each in objects] == [False, True]
    with pytest.raises(DataError, match="is an energyscape file"):
        check_recording(image)


def test_sensors_of_a_file_are_named(tmp_path):
    named = [
        dataclasses.replace(each, stamp=dataclasses.replace(stamp(number), sensor=name))
        for name, each in (("left", sound()), ("right", BY_HAND["stuck at 0"]()))
        for number in range(2)
    ]
    path = write_recording(tmp_path / "a.h5", named)
    assert verdict_of(path).startswith("a.h5: 1 fault: sensor right: channel 3 is stuck at 0. Remedy: ")


def test_echoes_of_another_call_are_a_fault(tmp_path):
    call = real().settings.call
    other = call.replace(start_frequency_hz=call.stop_frequency_hz, stop_frequency_hz=call.start_frequency_hz)
    (tmp_path / "s.toml").write_text(
        f"[call]\nstart_frequency_hz = {other.start_frequency_hz}\nstop_frequency_hz = {other.stop_frequency_hz}\n"
    )
    path = stored(tmp_path / "a.h5", real(), real())
    last = run(path, "--settings", tmp_path / "s.toml", code=1).stdout.splitlines()[-1]
    assert "echoes do not match the call of the settings" in last
    assert last.endswith("set the emitted call as [call] in a settings file")


@pytest.mark.parametrize("is_reported", [False, True])
def test_other_order_in_the_calibration_alone_is_no_fault(is_reported):
    """Several echoes can fit another order by chance; the health check has stricter conditions."""
    residuals = dataclasses.replace(
        calibration_residuals([plane_array()], ()), findings=(ArrayFinding(text="channels are in the reversed order"),)
    )
    report = health(plane_array())
    finding = Finding(fault="order of channels", channels=tuple(range(32)), measured=30.0, limit=15.0)
    result = of_calibration(residuals, dataclasses.replace(report, findings=(finding,) * is_reported))
    assert result.result == ("ok" if is_reported else "not known")
    assert result.faults == ()


def test_layout_that_fits_instead_is_a_fault():
    result = of_calibration(OtherLayoutError("own", 0.4, "eRTIS_v2"), None)
    ((text, remedy),) = [(fault.text, fault.remedy) for fault in result.faults]
    assert text == "layout own does not fit the recordings (40% of the microphones), but layout eRTIS_v2 does"
    assert remedy == 'set array.layout = "eRTIS_v2" in a settings file (--settings)'


def test_another_layout_deviates(tmp_path):
    path = stored(tmp_path / "a.h5", plane_array())
    assert results(check_recording(path))["calibration"] == "ok"
    places_m = tuple(map(tuple, load_layout("eRTIS_v3D1").positions_m.tolist()))
    late = Array(positions_m=places_m, delay_s=tuple(30e-6 * (channel == 9) for channel in range(32)))
    checked = check_recording(path, settings=lambda settings: settings.replace(array=late))
    assert [fault.text.split(" by")[0] for fault in checked.faults] == ["channel 9 is late"]


def test_rate_is_validated(tmp_path):
    path = stored(tmp_path / "a.h5", sound())
    with pytest.raises(ArgumentError, match="nominal_rate_hz is nan; use a"):
        check_recording(path, nominal_rate_hz=float("nan"))
    assert run(path, "--rate", "nan", code=2).stderr.startswith("ertis: error: --rate is nan; use a finite number")
    assert "-1.0 is not in the range x>0" in run(path, "--rate", "-1", code=2).stderr
    assert "--rate is 1e+09; use a number from 1e-06 to 1e+06; see" in run(path, "--rate", "1e9", code=2).stderr


# Output.


def test_json_has_one_object_for_each_file(tmp_path):
    healthy, silent = stored(tmp_path / "a.h5", real()), stored(tmp_path / "b.h5", BY_HAND["stuck at 0"]())
    done = run(healthy, silent, "--json", code=1)
    first, second = (json.loads(line) for line in done.stdout.splitlines())
    assert (first["file"], first["fit"], first["faults"]) == (str(healthy), True, [])
    assert first["sensors"][0]["dynamic_range_db"] == pytest.approx(84, abs=3)
    assert [item["check"] for item in first["sensors"][0]["checks"]][:2] == ["microphones", "noise floor"]
    assert second["fit"] is False
    assert second["faults"] == [
        {
            "check": "microphones",
            "text": "channel 3 is stuck at 0",
            "remedy": "exclude channel 3 (--without 3)",
        }
    ]
    assert second["sensors"][0]["faulty_channels"] == {"stuck at 0": [3]}


def test_quiet_prints_only_faults(tmp_path):
    healthy, silent = stored(tmp_path / "a.h5", sound()), stored(tmp_path / "b.h5", BY_HAND["stuck at 0"]())
    assert run(healthy, silent, "--quiet", code=1).stdout.startswith(f"{silent}: 1 fault: channel 3 is stuck at 0. ")


class Page(html.parser.HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_page_has_all_results_and_no_external_resource(tmp_path):
    healthy, silent = stored(tmp_path / "a.h5", sound()), stored(tmp_path / "b.h5", BY_HAND["stuck at 0"]())
    done = run(healthy, silent, "--report", tmp_path / "r.html", code=1)
    assert done.stderr.endswith("r.html: report of 2 files\n")
    page = Page((tmp_path / "r.html").read_text("utf-8"))
    pictures = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    assert len(pictures) == 4
    assert all(picture.startswith("data:image/png;base64,iVBOR") for picture in pictures)
    assert {tag for tag, _ in page.tags} <= {
        *("html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "section"),
        *("p", "div", "table", "tr", "th", "td", "ul", "li", "img"),
    }
    assert not [attributes for tag, attributes in page.tags if "href" in attributes or "srcset" in attributes]
    for checked in map(check_recording, (healthy, silent)):
        assert checked.verdict in page.text
        assert all(item.detail in page.text for item in checked.sensors[0].items)
    assert ("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}) in page.tags


def test_page_has_an_entry_for_each_file_that_cannot_be_read(tmp_path):
    whole, target = stored(tmp_path / "a.h5", sound()), tmp_path / "r.html"
    cut, empty, absent = (tmp_path / f"{name}.h5" for name in ("cut", "empty", "absent"))
    cut.write_bytes(whole.read_bytes()[:9000])
    empty.touch()
    done = run(cut, whole, empty, absent, tmp_path, "--report", target, code=1)
    assert done.stderr.endswith("r.html: report of 5 files\n")
    page = Page(target.read_text("utf-8"))
    assert [attributes["class"] for _, attributes in page.tags if "verdict" in attributes.get("class", "")] == [
        f"verdict {state}" for state in ("fault", "ok", "fault", "fault", "fault")
    ]
    for text in ("the file is cut short or damaged", "the file is empty", "No such file", "the file is a folder"):
        assert text in page.text


def test_page_of_an_earlier_check_does_not_survive(tmp_path):
    target, absent = tmp_path / "r.html", tmp_path / "absent.h5"
    run(stored(tmp_path / "a.h5", sound()), "--report", target)
    assert "no fault in" in target.read_text("utf-8")
    run(absent, "--report", target, "--force", code=1)
    assert "no fault in" not in target.read_text("utf-8")
    assert "No such file" in target.read_text("utf-8")
    target.write_text("fit for use")
    run(tmp_path / "a.h5", "--report", target, "--force", "--settings", tmp_path / "absent.toml", code=1)
    assert "fit for use" not in target.read_text("utf-8")


def test_settings_that_do_not_suit_a_file_are_its_fault(tmp_path):
    first, second = stored(tmp_path / "a.h5", plane_array()), stored(tmp_path / "b.h5", sound())
    done = run(second, first, "--without", "20", "--json", code=1)
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert [each["fit"] for each in reports] == [False, True]
    assert reports[0]["faults"][0]["text"].startswith("array.disabled is 20")
    assert reports[0].keys() - {"error"} == reports[1].keys()


def test_page_without_plots_if_the_file_has_vanished(tmp_path):
    path = stored(tmp_path / "a.h5", sound())
    checked = check_recording(path)
    path.unlink()
    text = write_page(tmp_path / "r.html", [checked]).read_text("utf-8")
    assert "No plots" in text
    assert "No such file" in text


def test_page_escapes_texts_of_files(tmp_path):
    name = "<img src=x onerror=alert(1)>'\".h5"
    layout = dataclasses.replace(
        sound(), settings=sound().settings.replace(array=sound().settings.array.replace(layout="<b>&'"))
    )
    path = stored(tmp_path / name, layout)
    target = write_page(tmp_path / "r.html", [check_recording(path)])
    page = Page(target.read_text("utf-8"))
    assert name in page.text
    assert "Layout <b>&'" in page.text
    assert not [attributes for _, attributes in page.tags if "onerror" in attributes]


def test_page_is_not_overwritten_without_force(tmp_path):
    path = stored(tmp_path / "a.h5", sound())
    target = tmp_path / "r.html"
    target.write_text("mine")
    done = run(path, "--report", target, code=1)
    assert done.stderr == (
        f"ertis: error: output {target} exists; choose another name, or replace the file (--force)\n"
    )
    assert done.stdout == ""
    assert target.read_text() == "mine"
    assert "is the input itself" in run(path, "--report", path, "--force", code=1).stderr
    before = path.read_bytes()
    run(path, "--report", target, "--force", "--quiet")
    assert path.read_bytes() == before
    assert target.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.h5", "r.html"]


def test_check_page_shows_the_printed_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = path_of("check").read_text("utf-8")
    for block in re.findall(r"```\n(.*?)```", page, re.DOTALL):
        for part in block.split("$ ertis ")[1:]:
            command, shown = part.split("\n", 1)
            done = CliRunner().invoke(cli, command.split())
            assert not shown or done.stdout == shown, command
            assert done.exit_code == int("fault:" in shown or "faults:" in shown), command
    (code,) = python_in(page)
    run_code_here(tmp_path, code)
    assert Page((tmp_path / "REPORT.html").read_text("utf-8")).text.count("no fault in") == 1


def test_page_of_limits_has_the_limits():
    page = " ".join(path_of("health-checks").read_text("utf-8").split())
    assert f"more than {MAX_DRIFT_PPM:g} ppm" in page
    assert f"{1e6 * limits.MAX_DELAY_S:g} µs or {limits.MAX_GAIN_DB:g} dB" in page
