"""Fused images of a central node, as an application receives them."""

import json
import threading

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.network.processes import until
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.fusion import Fuser
from ertis_numba.network.fused_subscriber import FusedSubscriber
from tests.publishing import PATIENCE_S, PATIENT_APPLICATIONS, Publisher, image, patient_applications

__all__ = ["patient_applications"]  # A fixture, imported for use here.

pytestmark = PATIENT_APPLICATIONS

AHEAD, BEHIND = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)
MOUNTINGS = {"front": ((0.2, 0.0, 0.0), AHEAD), "back": ((-0.2, 0.0, 0.0), BEHIND)}


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Delay each pulse until images that a busy machine sends late have arrived."""
    monkeypatch.setattr("ertis_numba.network.pulse_receiver._PATIENCE_S", PATIENCE_S)


def pulses(*, count=3, absent=()):
    """Images of two sensors that look in opposite directions, each with a reflector."""
    return [
        image(number, sensor=sensor, reflectors=[(20.0, range_m, 0.1)])
        for number in range(count)
        for sensor, range_m in (("front", 1.3), ("back", 1.0))
        if (number, sensor) not in absent
    ]


def test_each_pulse_is_fused_once():
    with (
        Publisher() as publisher,
        publisher.playing(pulses()),
        FusedSubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
    ):
        arrivals = [subscriber.receive(PATIENCE_S) for _ in range(2)]
    counts = [arrival.fused.stamp.sync_count for arrival in arrivals]
    assert counts == sorted(set(counts))
    last = arrivals[-1].fused
    assert (last.sensors, last.missing) == (("front", "back"), ())
    assert sorted(round(float(x), 1) for x in last.points.position_m[:, 0]) == [-1.1, 1.4]


@pytest.mark.parametrize(("n_cores", "name"), [(1, "ertis-pulse-receiver"), (2, "ertis-images")])
def test_threads_find_echoes_as_images_arrive_and_end_with_the_subscriber(monkeypatch, n_cores, name):
    prepare, used, found = Fuser.prepare, threading.Semaphore(0), []

    def seen(fuser, each):
        found.append((threading.current_thread().name, each))
        prepare(fuser, each)

    def one_after_the_other():
        front, back, *others = pulses()
        yield from (front, back)
        for each in zip(others[::2], others[1::2], strict=True):
            assert used.acquire(timeout=PATIENCE_S)
            yield from each

    monkeypatch.setattr(Fuser, "prepare", seen)
    monkeypatch.setattr("ertis_numba.network.pulse_receiver.usable_cores", lambda: n_cores)
    arrivals = []
    with (
        Publisher() as publisher,
        FusedSubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
        publisher.playing(one_after_the_other()),
    ):
        for _ in range(3):
            arrivals.append(subscriber.receive(PATIENCE_S))
            used.release()
        sent = {id(each) for arrival in arrivals[1:] for each in arrival.images.values()}
        assert until(lambda: sent <= {id(each) for _, each in found}, timeout_s=PATIENCE_S)
    assert {thread.rpartition("_")[0] or thread for thread, _ in found} == {name}
    assert not any(each.name.startswith("ertis-images") for each in threading.enumerate())
    fuser = Fuser(MOUNTINGS, spacing_deg=2.0, range_step_m=0.02)
    for arrival in arrivals:
        again = fuser(arrival.images.values())
        np.testing.assert_array_equal(arrival.fused.image.amplitude, again.image.amplitude)


def test_pulses_that_arrive_while_tables_are_computed_are_fused_later(monkeypatch):
    fuse = Fuser.__call__
    begun = threading.Event()

    def slowly(fuser, images):
        """Fuse, and the first time return only once all further pulses have arrived."""
        begun.set()
        fused = fuse(fuser, images)
        if fused.stamp.sync_count == 0:
            waiting = subscriber._receiver.queue._waiting  # noqa: SLF001
            assert until(lambda: len(waiting) == 7, timeout_s=PATIENCE_S)
            assert subscriber.counts.received == 16
        return fused

    def first_one_and_then_others():
        """Send nothing between the first pulse and the begin of its fusion, so that none is skipped before."""
        front, back, *others = pulses(count=8)
        yield from (front, back)
        assert begun.wait(PATIENCE_S)
        yield from others

    with (
        Publisher() as publisher,
        FusedSubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
        publisher.playing(first_one_and_then_others()),
    ):
        monkeypatch.setattr(Fuser, "__call__", slowly)
        counts = [subscriber.receive(PATIENCE_S).fused.stamp.sync_count for _ in range(8)]
        assert (counts, subscriber.n_skipped) == ([*range(8)], 0)


def test_images_of_an_arrival_are_those_that_were_fused():
    with (
        Publisher() as publisher,
        publisher.playing(pulses(count=1)),
        FusedSubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
    ):
        arrival = subscriber.receive(PATIENCE_S)
    again = Fuser(MOUNTINGS, spacing_deg=2.0, range_step_m=0.02)(arrival.images.values())
    assert sorted(arrival.images) == ["back", "front"]
    np.testing.assert_array_equal(arrival.fused.image.amplitude, again.image.amplitude)


def test_pulse_without_all_images_is_fused_by_the_next_one():
    sent = pulses(count=4, absent={(2, "back")})
    with (
        Publisher() as publisher,
        publisher.playing(sent),
        FusedSubscriber(publisher.address, mountings=MOUNTINGS) as subscriber,
    ):
        found = {}
        while 3 not in found:
            fused = subscriber.receive(PATIENCE_S).fused
            found[fused.stamp.sync_count] = fused.sensors, fused.missing
    assert found.get(2, (("front",), ("back",))) == (("front",), ("back",))
    assert found[3] == (("front", "back"), ())


def test_mountings_of_the_central_node_are_used():
    sent = [image(number, sensor=sensor, reflectors=[(20.0, 1.5, 0.1)]) for number in (0, 1) for sensor in MOUNTINGS]
    with (
        Publisher() as publisher,
        publisher.playing(sent),
        FusedSubscriber(publisher.address) as subscriber,
    ):
        fused = subscriber.receive(PATIENCE_S).fused
    x, y, z = fused.points.position_m[0].tolist()
    assert (x < 1.0, y < 2.0, round(z, 2)) == (True, True, 3.0)  # Both sensors are at (1, 2, 3) and look back.


@pytest.mark.parametrize(
    ("mountings", "peak", "reason"),
    [
        ({"front": MOUNTINGS["front"]}, 0.1, "its mounting is unknown; add the mounting (mountings), or start"),
        (MOUNTINGS, np.nan, "its images contain NaN or infinity"),
    ],
)
def test_sensor_that_cannot_be_fused_is_left_out_with_one_note(mountings, peak, reason):
    sent = [
        image(number, sensor=sensor, reflectors=[(20.0, 1.5, peak if sensor == "back" else 0.1)])
        for number in range(8)  # Later pulses end the wait for the image of the sensor that is left out.
        for sensor in ("back", "front")
    ]
    notes = []
    with Publisher() as publisher:
        publisher.translation_m = publisher.rotation_xyzw = None
        with (
            publisher.playing(sent),
            FusedSubscriber(publisher.address, mountings=mountings, on_note=notes.append) as subscriber,
        ):
            found = {}
            while max(found, default=0) < 3:  # A slow application skips pulses.
                fused = subscriber.receive(PATIENCE_S).fused
                found[fused.stamp.sync_count] = fused.sensors
    assert set(found.values()) == {("front",)}
    assert [reason in note for note in notes if note.startswith("sensor back is left out")] == [True]


def test_pulse_that_cannot_be_fused_is_left_out_and_noted(monkeypatch):
    fuse = Fuser.has_tables

    def refused(fuser, images):
        if any(each.stamp.sync_count == 1 for each in images):
            raise DataError("it is refused")
        return fuse(fuser, images)

    monkeypatch.setattr(Fuser, "has_tables", refused)
    notes, used = [], threading.Semaphore(0)

    def one_by_one():
        for each in pulses():
            yield each
            if each.stamp.sensor == "back":
                assert used.acquire(timeout=PATIENCE_S)

    def note(text):
        if text.startswith("SYNC pulse"):
            notes.append(text)
            used.release()

    counts = []
    with (
        Publisher() as publisher,
        publisher.playing(one_by_one()),
        FusedSubscriber(publisher.address, mountings=MOUNTINGS, on_note=note) as subscriber,
    ):
        while 2 not in counts:
            counts.append(subscriber.receive(PATIENCE_S).fused.stamp.sync_count)
            used.release()
    assert (counts, notes) == ([0, 2], ["SYNC pulse 1 is left out: it is refused"])


def test_closed_subscriber_ends_the_loop():
    with Publisher() as publisher, publisher.playing([]), FusedSubscriber(publisher.address) as subscriber:
        assert subscriber.receive(0.05) is None
        subscriber.close()
        assert list(subscriber) == []


def test_invalid_address_is_refused():
    with pytest.raises(ArgumentError, match="nowhere"):
        FusedSubscriber("nowhere")


def test_listen_prints_fused_pulses(tmp_path):
    mounting = tmp_path / "mounting.toml"
    mounting.write_text(
        '[[sensors]]\nname = "front"\nposition_m = [0.2, 0.0, 0.0]\n\n'
        '[[sensors]]\nname = "back"\nposition_m = [-0.2, 0.0, 0.0]\nyaw_deg = 180.0\n'
    )
    arguments = ["--fuse", "--mounting", str(mounting), "-n", "1", "--duration", "200", "-q"]
    with Publisher() as publisher, publisher.playing(pulses(count=6)):
        shown = CliRunner().invoke(cli, ["listen", publisher.address, *arguments, "--json"])
    assert shown.exit_code == 0, shown.output
    subscribed, fused, summary = map(json.loads, shown.stdout.splitlines())
    assert (subscribed["event"], subscribed["products"]) == ("subscribed", ["energyscape"])
    assert fused["sensors"] == ["front", "back"]
    assert fused["nearest_m"][0] == pytest.approx(-1.14, abs=0.02)
    assert all(0 < sd_m < 0.05 for sd_m in fused["nearest_sd_m"])
    assert (summary["received"], summary["dropped"]) == (1, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fuse", "--product", "points"], "--product applies only without --fuse"),
        (["--fuse", "--save", "a.h5"], "--save applies only without --fuse"),
        (["--mounting", "a.toml"], "--mounting applies only with --fuse"),
    ],
)
def test_listen_refuses_options_that_do_not_fit(arguments, message):
    shown = CliRunner().invoke(cli, ["listen", "tcp://127.0.0.1:5602", *arguments])
    assert (shown.exit_code, message in shown.output) == (2, True), shown.output
