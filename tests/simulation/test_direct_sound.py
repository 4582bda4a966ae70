"""Direct sound between sensors shows wrong clocks and mountings, and accuses no others."""

import dataclasses
import functools
import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.base.errors import ArgumentError
from ertis_numba.fusion import DirectSoundCheck
from ertis_numba.fusion.audibility import audible_ratio
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Call, Processing, Recording
from ertis_numba.simulation import Emitter, Point, Scene
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.storage import write_recording
from tests.fusion import test_fusion
from tests.scenes import only

SENSORS = tuple(test_fusion.YAWS)
LATE = 20  # Number of the measurement one second after a SYNC pulse.


@functools.cache
def scene(drifting="", drift_ppm=0.0, names=SENSORS, **emitter):
    """A platform whose sensors hear each other; the SYNC pulses come every two seconds."""
    base = test_fusion.scene(diameter_m=0.0)
    sensors = tuple(
        each.replace(
            electronics=each.electronics.replace(clock_drift_ppm=drift_ppm if each.name == drifting else 0.0),
            emitter=each.emitter.replace(**emitter),
            recording=Recording(n_samples=32_768),
            processing=Processing(range_m=(0.3, 0.6), directions="90"),
        )
        for each in base.sensors
        if each.name in names
    )
    return base.replace(sensors=sensors, rate_hz=20.0, sync_every=40)


def heard(made, index=0):
    plan = only(*EFFECTS)  # which takes no time
    return [ertis.Simulator(made, sensor=each.name, plan=plan).render(index) for each in made.sensors]


def mountings(made, **moved_m):
    return {
        each.name: (np.add(each.position_m, moved_m.get(each.name, 0.0)).tolist(), each.quaternion())
        for each in made.sensors
    }


def checked(made, index=0, **moved_m):
    check = DirectSoundCheck(mountings(made, **moved_m))
    check.add(heard(made, index))
    return check


def test_direct_sound_of_right_clocks_shows_the_sync_chain_only():
    check = checked(scene())
    assert {(each.emitter, each.receiver) for each in check.sounds} == {
        (one, other) for one in SENSORS for other in SENSORS if one != other
    }
    for each in check.sounds:
        later = (SENSORS.index(each.emitter) - SENSORS.index(each.receiver)) * SYNC_STEP_S
        assert abs(each.difference_s - later) < 3 * each.noise_s
        assert each.uncertainty_s < 10e-6
    assert check.warnings() == ()


@pytest.mark.parametrize("drift_ppm", [20.0, -300.0])
def test_wrong_clock_is_found(drift_ppm):
    check = checked(scene("left", drift_ppm), LATE)
    (warning,) = check.warnings()
    way = "earlier" if drift_ppm > 0 else "later"
    assert warning.startswith("left emits and records ")
    assert f" µs {way} than the other sensors, ± " in warning
    late_us = float(warning.split()[4])
    assert late_us == pytest.approx(abs(drift_ppm), abs=2.0)


@pytest.mark.parametrize("deaf", [("right", "back"), ("left", "front"), ("left", "right")])
def test_sensors_that_do_not_hear_each_other_are_compared_over_others(deaf):
    made = scene("left", 100.0, ("front", "left", "right", "back"))
    check = DirectSoundCheck(mountings(made))
    measurements = heard(made, LATE)
    alone = (
        [each for each in measurements if each.stamp.sensor != deaf[0]],
        [each for each in measurements if each.stamp.sensor != deaf[1]],
    )
    for group in alone:
        check.add(group)
    assert deaf not in {(each.emitter, each.receiver) for each in check.sounds}
    (warning,) = check.warnings()
    assert warning.startswith("left emits and records ")
    assert float(warning.split()[4]) == pytest.approx(100, abs=2.0)


def test_both_neighbours_of_a_wrong_clock_are_right():
    made = scene("left", 100.0, ("front", "left", "back"))
    check = DirectSoundCheck(mountings(made))
    measurements = {each.stamp.sensor: each for each in heard(made, LATE)}
    for other in ("front", "back"):
        check.add([measurements["left"], measurements[other]])
    (warning,) = check.warnings()
    assert warning.startswith("left emits and records ")
    assert float(warning.split()[4]) == pytest.approx(100, abs=2.0)


def test_clock_is_right_at_the_sync_pulse():
    assert checked(scene("left", -300.0), 0).warnings() == ()


def test_two_sensors_are_named_together():
    made = scene("left", 100.0, ("front", "left"))
    (warning,) = checked(made, LATE).warnings()
    assert warning.startswith(("left emits and records ", "front emits and records "))
    assert " than front, ± " in warning or " than left, ± " in warning


def test_wrong_mounting_is_found_and_clocks_are_not_accused():
    warnings = checked(scene(), left=(0.0, 0.01, 0.0)).warnings()
    assert len(warnings) == 3
    assert all("left" in each and "closer together than their mountings state" in each for each in warnings)


def test_errors_within_the_uncertainty_of_mountings_are_not_accused():
    assert checked(scene(), left=(0.0, 0.002, 0.0)).warnings() == ()


def test_own_direct_sound_and_delayed_calls_do_not_matter():
    made = scene(direct_sound_db=-30.0)
    delays = dict(zip(SENSORS, (1e-3, 0.0, 2e-3, 0.0), strict=True))
    sensors = tuple(each.replace(call=Call(delay_s=delays[each.name])) for each in made.sensors)
    check = checked(made)
    assert (len(check.sounds), check.warnings()) == (12, ())
    check = checked(made.replace(sensors=sensors))
    heard_by_front = {each.emitter for each in check.sounds if each.receiver == "front"}
    assert heard_by_front == {"back"}  # Sound of the others arrives together with the sensor's own.
    assert len(check.sounds) >= 8
    assert check.warnings() == ()


def test_inaudible_sound_is_not_reported():
    assert checked(scene(silent=True)).sounds == ()
    assert checked(scene(diameter_m=0.012)).sounds == ()


def test_sound_that_is_heard_in_few_pulses_is_not_reported():
    loud, silent = heard(scene(names=("front", "left"))), heard(scene(diameter_m=0.012, names=("front", "left")))
    check = DirectSoundCheck(mountings(scene(names=("front", "left"))))
    check.add(loud)
    assert len(check.sounds) == 2
    check.add(silent)
    assert check.sounds == ()
    check.add(loud)
    assert len(check.sounds) == 2


@pytest.mark.parametrize(("drift_ppm", "heard_pairs"), [(480.0, 2), (530.0, 0)])
def test_maximum_at_the_end_of_the_window_is_no_sound(drift_ppm, heard_pairs):
    assert len(checked(scene("left", drift_ppm, ("front", "left")), LATE).sounds) == heard_pairs


@pytest.mark.parametrize("rate", [0.1, 0.01])
def test_noise_exceeds_the_threshold_as_rarely_as_stated(rate):
    """The limit counts each rise above the threshold, so it exceeds the probability, but by less than threefold."""
    settings = scene().sensors[0].settings()
    window_s, pulse_s, n_windows = 500e-6, 120e-6, 10_000
    ratio = audible_ratio(settings, searched_s=2 * window_s, averaged_s=2 * (window_s - pulse_s), false_alarms=rate)
    values = matched_filter_spectrum(settings, n_fft=2048).values
    frequency_hz = np.arange(len(values)) * settings.signal_rate_hz / 2048
    time_s = np.linspace(-window_s, window_s, 401)
    waves = np.exp(2j * np.pi * frequency_hz[:, None] * time_s) * np.abs(values)[:, None]
    draws = np.random.default_rng(7)
    exceeded = 0
    for _ in range(10):
        noise = draws.normal(size=(n_windows // 10, len(values), 2)) @ [1, 1j]
        level = np.abs(noise @ waves)
        peak = level.argmax(axis=1)
        outside = np.abs(time_s - time_s[peak, None]) >= pulse_s
        background = np.sqrt(np.sum(level**2 * outside, axis=1) / outside.sum(axis=1))
        exceeded += np.count_nonzero(level.max(axis=1) > ratio * background)
    spread = 3 * np.sqrt(rate * n_windows)
    assert rate * n_windows / 3 - spread < exceeded < rate * n_windows + spread


def test_sound_that_is_heard_one_way_is_reported():
    made = scene("left", 100.0, ("front", "left"))
    sensors = tuple(each.replace(emitter=Emitter(silent=each.name == "front")) for each in made.sensors)
    check = checked(made.replace(sensors=sensors), LATE)
    (warning,) = check.warnings()
    assert warning.startswith("direct sound of left arrives at front ")
    assert " earlier than predicted, ± " in warning


def as_active(measurement):
    """The measurement of a sensor whose emitter is broken, which the sensor does not know."""
    return ertis.Measurement(
        measurement.data, measurement.settings, dataclasses.replace(measurement.stamp, behaviour="active")
    )


@pytest.mark.parametrize(
    ("names", "diameter_m", "direct_sound_db", "expected"),
    [
        (("front", "left"), 0.0, None, ("left",)),
        (SENSORS, 0.0, None, ("left",)),
        (SENSORS, 0.012, -20.0, ("left",)),  # Neighbours do not hear it, but the others hear themselves.
        (("front", "left"), 0.012, -20.0, ("left",)),
        (SENSORS, 0.012, None, ()),  # Nothing shows it.
    ],
)
def test_direct_sound_shows_a_broken_emitter(names, diameter_m, direct_sound_db, expected):
    made = scene(names=names, diameter_m=diameter_m, direct_sound_db=direct_sound_db)
    assert checked(made).silent == ()
    sensors = tuple(each.replace(emitter=each.emitter.replace(silent=each.name == "left")) for each in made.sensors)
    check = DirectSoundCheck(mountings(made))
    check.add(map(as_active, heard(made.replace(sensors=sensors))))
    assert check.silent == expected
    assert check.warnings() == tuple(
        f"{name} emits no sound, unlike the other sensors; check its emitter" for name in expected
    )


def test_measurement_without_a_mounting_is_refused():
    made = scene()
    check = DirectSoundCheck({"front": mountings(made)["front"]})
    with pytest.raises(ArgumentError, match="measurements has sensor 'left', whose mounting is unknown"):
        check.add(heard(made))


def test_process_reports_direct_sound_and_warns(tmp_path):
    made = scene("left", 100.0, ("front", "left"))
    paths = []
    for each, measurement in zip(made.sensors, heard(made, LATE), strict=True):
        paths.append(tmp_path / f"{each.name}.h5")
        write_recording(paths[-1], [measurement], mounting={each.name: (each.position_m, each.quaternion())})
    line = ["fuse", *map(str, paths), "--directions", "2d:9", "-o", str(tmp_path / "f.h5"), "--json"]
    done = CliRunner().invoke(cli, line)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout.splitlines()[-1])
    assert {(each["emitter"], each["receiver"]) for each in report["direct_sound"]} == {
        ("front", "left"),
        ("left", "front"),
    }
    assert all(90 < abs(each["difference_us"]) < 110 for each in report["direct_sound"])
    clocks, directions = report["warnings"]
    assert "apart, so a reflector between them appears" in directions
    for warning in (clocks, directions):
        assert f"ertis: warning: {warning}" in done.stderr


def test_scene_of_nothing_but_sensors_suffices():
    made = Scene(sensors=scene().sensors, points=(Point(position_m=(3.0, 0.0, 0.4)),))
    assert checked(made).warnings() == ()
