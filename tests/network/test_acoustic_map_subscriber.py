"""Acoustic maps of a central node's measurements, as an application makes them."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli._listen_bearings import _show
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Bearing, Measurement
from ertis_numba.geometry.air import transmission_loss_db
from ertis_numba.network.acoustic_map_subscriber import AcousticMapSubscriber
from ertis_numba.passive import AcousticCamera
from tests.publishing import PATIENCE_S, PATIENT_APPLICATIONS, Publisher, measurement, patient_applications

__all__ = ["patient_applications"]  # A fixture, imported for use here.

pytestmark = PATIENT_APPLICATIONS

ROOT = Path(__file__).parents[2]


def passive(number, *, behaviour="passive", **changes):
    made = measurement(number, **changes)
    return Measurement(made.data, made.settings, dataclasses.replace(made.stamp, behaviour=behaviour))


def test_maps_are_those_of_the_camera():
    sent = [passive(number, sensor=sensor) for number in range(2) for sensor in ("front", "back")]
    with (
        Publisher() as publisher,
        publisher.playing(sent),
        AcousticMapSubscriber(publisher.address, device="cpu") as subscriber,
    ):
        found = [subscriber.receive(PATIENCE_S) for _ in range(2)]
    with AcousticCamera(sent[0].settings, "cpu", check=False) as camera:
        for each in found:
            (original,) = (
                one
                for one in sent
                if (one.stamp.sensor, one.stamp.sequence) == (each.stamp.sensor, each.stamp.sequence)
            )
            np.testing.assert_array_equal(each.power, camera.process(original).power)


def test_measurements_are_averaged_by_sensor():
    sent = [passive(number, temperature_c=20.0 + number) for number in range(4)]
    with (
        Publisher() as publisher,
        AcousticMapSubscriber(publisher.address, changes={"passive.averages": 2}, device="cpu") as subscriber,
        publisher.playing(sent),
    ):
        found = subscriber.receive(PATIENCE_S)
    assert found.n_measurements == 2


def test_maps_follow_the_speed_of_sound():
    sent = [passive(number, temperature_c=celsius) for number, celsius in enumerate((10.0, 10.2, 30.0))]
    found = {}
    with (
        Publisher() as publisher,
        AcousticMapSubscriber(publisher.address, device="cpu") as subscriber,
        publisher.playing(sent),
    ):
        while 2 not in found:
            each = subscriber.receive(PATIENCE_S)
            found[each.stamp.sequence] = each
    assert found[2].settings.air.temperature_c == 30.0
    with AcousticCamera(sent[2].settings, "cpu", check=False) as camera:
        np.testing.assert_array_equal(found[2].power, camera.process(sent[2]).power)


def test_measurements_with_a_call_become_no_map_unless_asked():
    sent = [passive(number, behaviour="active") for number in range(2)]
    with (
        Publisher() as publisher,
        AcousticMapSubscriber(publisher.address, changes={"processing.mode": "passive"}, device="cpu") as subscriber,
        publisher.playing(sent),
    ):
        found = subscriber.receive(PATIENCE_S)
        assert found.masked_s > found.settings.call.duration_s
    with (
        Publisher() as publisher,
        AcousticMapSubscriber(publisher.address, device="cpu") as subscriber,
        publisher.playing([*sent, passive(2)]),
    ):
        assert subscriber.receive(PATIENCE_S).stamp.sequence == 2
        assert subscriber.n_active <= 2  # the central node may drop some for a slow application


def test_changes_that_cannot_be_used_are_refused():
    with pytest.raises(ArgumentError, match="passive"):
        AcousticMapSubscriber("tcp://127.0.0.1:5602", changes={"passive.method": "loudest"})
    with pytest.raises(ArgumentError, match="nowhere"):
        AcousticMapSubscriber("nowhere")


def test_settings_that_cannot_be_used_are_an_error():
    changes = {"passive.resolution_hz": 29.0}  # longer than the short record of the sensor
    with (
        Publisher() as publisher,
        AcousticMapSubscriber(publisher.address, changes=changes, device="cpu") as subscriber,
        publisher.playing([short()]),
        pytest.raises(DataError, match="cannot be used for acoustic maps"),
    ):
        subscriber.receive(PATIENCE_S)


def test_closed_subscriber_ends_the_loop():
    with Publisher() as publisher, publisher.playing([]), AcousticMapSubscriber(publisher.address) as subscriber:
        assert subscriber.receive(0.05) is None
        subscriber.close()
        assert list(subscriber) == []


def short():
    made = passive(0)
    settings = made.settings.replace("recording.n_samples", 81_920)
    return Measurement(made.data[:81_920], settings, made.stamp)


def heard_leak(directions, n=1):
    scene = ertis.load_scene(ROOT / "data" / "synthetic" / "scenes" / "leak.toml")
    sensor = scene.sensors[0].replace(**{"processing.directions": directions})
    heard = ertis.render(scene.replace(sensors=(sensor,)))
    changes = {"processing.directions": directions, "passive.bands_hz": [[40e3, 60e3]], "passive.focus_m": 2.5}
    settings = heard.settings.replace(**changes)
    return [Measurement(heard.data, settings, dataclasses.replace(heard.stamp, sequence=k)) for k in range(n)]


def listen_to_bearings(measurements, *arguments):
    with Publisher() as publisher, publisher.playing(measurements):
        asked = ["--bearings", "--average", "1", "-n", str(len(measurements)), "--duration", "200", *arguments]
        shown = CliRunner().invoke(cli, ["listen", publisher.address, *asked])
    assert shown.exit_code == 0, shown.output
    return shown


def test_listen_prints_bearings():
    (heard,) = heard_leak("3d:1000")
    settings, shown = heard.settings, listen_to_bearings([heard], "-q", "--json")
    first, found, summary = map(json.loads, shown.stdout.splitlines())
    assert (first["event"], first["sensors"], first["products"]) == ("subscribed", None, ["raw"])
    assert (summary["received"], found["averages"], found["sensor"]) == (1, 1, "inspector")
    (leak,) = found["bearings"]
    assert (leak["azimuth_deg"], leak["elevation_deg"]) == (pytest.approx(28, abs=0.5), pytest.approx(12, abs=0.5))
    assert leak["level_db"] - leak["level_dbfs"] == pytest.approx(94 + 26 + 3, abs=0.05)
    loss_db = transmission_loss_db(settings.air, 2.5, np.sqrt([40e3 * 60e3]))[0]
    assert leak["source_level_db"] - leak["level_db"] == pytest.approx(loss_db, abs=0.01)


def test_listen_searches_a_half_space_whatever_the_directions():
    shown = listen_to_bearings(heard_leak("2d:61"), "--json")
    assert "warning" not in shown.stderr
    _, found, _ = map(json.loads, shown.stdout.splitlines())
    (leak,) = found["bearings"]
    assert (leak["azimuth_deg"], leak["elevation_deg"]) == (pytest.approx(28, abs=0.5), pytest.approx(12, abs=0.5))


@pytest.mark.parametrize("as_json", [True, False])
def test_unknown_direction_is_printed_as_such(capsys, as_json):
    (heard,) = heard_leak("2d:61")
    with AcousticCamera(heard.settings, "cpu", check=False) as camera:
        found = camera.process(heard)
    bearing = Bearing(
        azimuth_deg=20.0,
        elevation_deg=0.0,
        sideways_deg=np.inf,
        upwards_deg=np.inf,
        correlation=0.0,
        band_hz=(40e3, 60e3),
        level_dbfs=-70.0,
        snr_db=3.0,
    )
    _show(found, [bearing], 1.0, as_json=as_json)
    shown = capsys.readouterr().out
    if as_json:
        (printed,) = json.loads(shown)["bearings"]
        assert (printed["sideways_deg"], printed["upwards_deg"]) == (None, None)
    else:
        assert shown.count("unknown") == 2
        assert "inf" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--bearings", "--product", "raw"], "--product applies only without --bearings"),
        (["--bearings", "--fuse"], "--fuse and --bearings cannot be combined"),
        (["--average", "3"], "--average applies only with --bearings"),
    ],
)
def test_listen_refuses_options_that_do_not_fit_bearings(arguments, message):
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:5602", *arguments])
    assert shown.exit_code == 2
    assert message in shown.stderr
