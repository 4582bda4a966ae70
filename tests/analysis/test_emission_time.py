"""Time of the emission from direct sound. The truth is a call of closed form at times between the samples."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.emission_time import EmissionTimes, describe_start, emission_time_s, emissions_of
from ertis_numba.analysis.health.emission import describe_shift, fit_emission
from ertis_numba.analysis.sound_checks import SoundChecks
from ertis_numba.base.errors import StartMismatchWarning
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.network.processing._predictions import Predictions
from ertis_numba.pipeline import Pipeline
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import Array, Recording, Settings
from ertis_numba.viewer import Playback
from tests.interop.test_sync_channel import call

RATE_HZ = 192_000
SPEED_M_S = sound_speed_m_s(Settings().air)
RANDOM = np.random.default_rng(3)


def placed(positions_m):
    return Array(layout="own", positions_m=tuple(map(tuple, np.asarray(positions_m, float).tolist())))


ARRAYS = {
    "line of 6": placed([(0, 0.01 * place, 0) for place in np.arange(6) - 2.5]),
    "grid of 9": placed([(0, 0.02 * y, 0.02 * z) for y in (-1, 0, 1) for z in (-1, 0, 1)]),
    "random": placed(np.column_stack([np.zeros(12), RANDOM.uniform(-0.1, 0.1, (12, 2))])),
    "eRTIS": Array(layout="eRTIS_v3D1"),
}


def measured(array, late_s, *, direct=0.3, place_m=(1.2, 0.2, 0.0), full=10.0, noise=1e-4, number=0):
    """A measurement of direct sound and of an echo from a place, in which the emission is late."""
    positions_m = microphones(array).positions_m
    settings = Settings(array=array, recording=Recording(sample_rate_hz=RATE_HZ, n_samples=3_840, encoding="float32"))
    settings = settings.replace("processing.range_m", (0.5, 2.0)).replace("processing.range_decimation", 4)
    time_s = np.arange(3_840) / RATE_HZ - late_s
    paths_m = np.linalg.norm(place_m) + np.linalg.norm(positions_m - place_m, axis=1)
    signals = [
        direct * call(time_s - np.linalg.norm(position_m) / SPEED_M_S) + 0.02 * call(time_s - path_m / SPEED_M_S)
        for position_m, path_m in zip(positions_m, paths_m, strict=True)
    ]
    signals = np.stack(signals, axis=1)
    signals += noise * np.random.default_rng(number).standard_normal(signals.shape)
    stamp = ertis.Stamp(sensor="sensor", sequence=number, sync_count=number, timestamp_ns=10**17 + number * 10**8)
    return Measurement(signals.clip(-full, full).astype("f4"), settings, stamp)


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize("late_s", [0.0, 1.37e-3, 4.1003e-3, -0.5e-3, -1.2e-3])
@pytest.mark.parametrize("full", [10.0, 0.05], ids=["clear", "saturated"])
def test_emission_is_found_by_its_direct_sound(array, late_s, full):
    assert emission_time_s(measured(ARRAYS[array], late_s, full=full)) == pytest.approx(late_s, abs=6e-6)


@pytest.mark.parametrize("array", ARRAYS)
@pytest.mark.parametrize(
    "place_m", [(1.2, 0.2, 0.0), (0.6, 0.0, 0.0), (0.25, 0.0, 0.0), (0.15, 0.1, 0.05), (0.3, -0.5, 0.2)]
)
def test_echoes_are_no_direct_sound(array, place_m):
    assert emission_time_s(measured(ARRAYS[array], 0.0, direct=0.0, place_m=place_m)) is None


def test_noise_is_no_direct_sound():
    for number in range(5):
        given = measured(ARRAYS["grid of 9"], 0.0, direct=0.0, noise=0.5, number=number)
        assert emission_time_s(given) is None


def test_ring_cannot_tell_direct_sound_from_an_echo_ahead():
    angles = np.arange(8) * np.pi / 4
    ring = placed(np.column_stack([np.zeros(8), 0.02 * np.cos(angles), 0.02 * np.sin(angles)]))
    assert emission_time_s(measured(ring, 1.37e-3)) is None


def test_single_microphones_have_no_emission_time():
    assert emission_time_s(measured(placed([(0, 0, 0), (0, 0.01, 0)]), 1.37e-3)) is None
    assert fit_emission(np.zeros(3), np.zeros((3, 3)), 343.0) is None


def test_faulty_channel_does_not_hide_the_direct_sound():
    given = measured(ARRAYS["grid of 9"], 1.37e-3)
    given.data[:, 3] = np.roll(given.data[:, 3], 300)
    assert emission_time_s(given) == pytest.approx(1.37e-3, abs=6e-6)


def test_emission_of_few_measurements_is_not_used():
    silent = measured(ARRAYS["grid of 9"], 0.0, direct=0.0)
    assert describe_start(map(emissions_of, [measured(ARRAYS["grid of 9"], 1e-3), silent]), SPEED_M_S) is None


@pytest.mark.parametrize("array", ARRAYS)
def test_second_emission_of_a_record_is_found(array):
    first, second = (measured(ARRAYS[array], late_s, number=number) for number, late_s in enumerate((0.0, 11e-3)))
    both = Measurement(first.data + second.data, first.settings)
    assert emissions_of(first) == EmissionTimes(pytest.approx(0.0, abs=6e-6), None)
    assert emissions_of(both) == EmissionTimes(pytest.approx(0.0, abs=6e-6), pytest.approx(11e-3, abs=6e-6))
    text, remedy = describe_start([emissions_of(both)], SPEED_M_S)
    assert text.startswith("a record contains several emissions, 11 ms apart")
    assert re.fullmatch(r"end each record before the next emission, or import again with --length 0\.01[01]\d*", remedy)
    ((subject, warning),) = SoundChecks().check(both)
    assert (subject, warning.rpartition("; ")[2]) == ("start", remedy)


SHIFTS = {
    "late": (
        [1.37e-3] * 3,
        r"arrives 1\.37 ms later than the distance of the emitter allows; all ranges are 23\.6 cm too large",
    ),
    "early": (
        [-0.5e-3] * 3,
        r"arrives 0\.5 ms earlier than the distance of the emitter allows; all ranges are 8\.\d+ cm too small",
    ),
    "drifting": ([1e-4, 3e-4, 5e-4], r"drifts from 0\.1 ms later to 0\.5 ms later .* wrong by up to 8\.\d+ cm"),
    "drifting around 0": ([-8e-5, 0.0, 8e-5], r"drifts from 0\.08 ms earlier to 0\.08 ms later"),
}


@pytest.mark.parametrize("name", SHIFTS)
def test_shift_is_described(name):
    late_s, message = SHIFTS[name]
    text, remedy = describe_shift(late_s, SPEED_M_S)
    assert re.search(message, text), text
    assert "--s" in remedy


@pytest.mark.parametrize("late_s", [[], [0.0], [5e-5, 4e-5], [-9e-5]])
def test_small_shifts_are_not_described(late_s):
    assert describe_shift(late_s, SPEED_M_S) is None


@pytest.mark.parametrize(
    ("late_s", "delay_s", "remedy"),
    [
        (
            [1.37e-3],
            0.0,
            "set call.delay_s = 0.00137 in the settings, or import again with --skip increased by 0",
        ),
        ([-5e-4], 2e-3, "set call.delay_s = 0.0015 in the settings, or import again with --skip reduced by 0.0005"),
        ([-5e-4], 0.0, "start recording 0.5 ms earlier, or import again with a smaller --skip"),
        ([0.0, 5e-4], 0.0, "trigger each record by its emission, or import again with --sync-channel, "),
    ],
)
def test_remedy_of_shifted_records(late_s, delay_s, remedy):
    assert describe_shift(late_s, SPEED_M_S, delay_s=delay_s)[1].startswith(remedy)


@pytest.mark.parametrize("late_s", [1.37e-3, -0.5e-3])
def test_pipelines_warn_once_of_a_shifted_start(late_s):
    given = measured(ARRAYS["grid of 9"], late_s)
    with Pipeline(given.settings, "cpu", 1) as pipeline:
        with pytest.warns(StartMismatchWarning, match="the direct sound arrives") as caught:
            pipeline.process(given)
        pipeline.process(given)
        assert [each.filename for each in caught if each.category is StartMismatchWarning] == [__file__]


def test_remedy_of_a_pipeline_removes_the_shift():
    given = measured(ARRAYS["grid of 9"], 1.37e-3)
    repaired = Measurement(given.data, given.settings.replace("call.delay_s", 0.00137))
    assert emission_time_s(repaired) == pytest.approx(0.0, abs=6e-6)
    assert SoundChecks().check(repaired) == []


def test_sound_checks_report_a_start_that_drifts():
    checks, found = SoundChecks(), []
    for number in range(16):
        found += [(number, *each) for each in checks.check(measured(ARRAYS["grid of 9"], 2e-5 * number))]
    ((number, subject, warning),) = found
    assert (number, subject) == (3, "start")
    assert "drifts from 0 ms later to 0.06 ms later" in warning


def test_sound_checks_name_the_start_but_not_the_layout():
    found = SoundChecks().check(measured(ARRAYS["eRTIS"], 1.37e-3))
    assert [each.subject for each in found] == ["start"]


def test_workers_and_views_report_a_shifted_start(tmp_path):
    given = [measured(ARRAYS["grid of 9"], 1.37e-3, number=number) for number in range(2)]
    predictions, found = Predictions("cpu"), []
    predictions.add("front", None, given[0])
    while predictions.busy:
        found += predictions.drain()
    assert [(each.sensor, each.event) for each in found] == [("front", "start_mismatch")]
    path, images = tmp_path / "rec.h5", tmp_path / "rec.energy.h5"
    ertis.write_recording(path, given)
    assert CliRunner().invoke(cli, ["process", str(path), "-o", str(images)]).exit_code == 0
    assert "1.37 ms later" in CliRunner().invoke(cli, ["info", str(images)]).stdout
    for shown in (path, images):
        with Playback(shown, device="cpu") as playback:
            playback.at(0)
            playback.at(1)
            assert sum("1.37 ms later" in note for note in playback.notes()) == 1


@pytest.mark.parametrize("name", ["late", "drifting around 0"])
def test_check_and_process_report_the_shift(tmp_path, name):
    late_s, message = SHIFTS[name]
    path = tmp_path / "rec.h5"
    ertis.write_recording(
        path, [measured(ARRAYS["grid of 9"], each, number=number) for number, each in enumerate(late_s)]
    )
    checked = check_recording(path)
    found = [fault for fault in checked.sensors[0].faults if "direct sound" in fault.text]
    assert len(found) == 1
    assert re.search(message, found[0].text)
    done = CliRunner().invoke(cli, ["process", str(path), "--json"])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["sensors"]
    assert re.search(message, done.stderr), done.stderr
    assert done.stderr.count("direct sound") == 1
    if name == "late":
        assert CliRunner().invoke(cli, ["process", str(path), "--strict", "--force"]).exit_code == 1


def test_record_that_begins_with_the_emission_has_no_shift(tmp_path):
    path = ertis.write_recording(tmp_path / "rec.h5", [measured(ARRAYS["grid of 9"], 0.0)])
    assert not any("direct sound" in fault.text for fault in check_recording(path).sensors[0].faults)
