"""Live images of a central node: selection, duration of display, and stated age."""

import itertools
import time

import pytest

from ertis_numba.base.errors import RefusedError
from ertis_numba.network.messages import Refused
from ertis_numba.network.status import SensorStatus
from ertis_numba.viewer import Choices, Live, Pose, Viewer, _live
from ertis_numba.viewer._page import ControlRequest
from tests.ports import reserved_address
from tests.publishing import Publisher, image as published, status
from tests.views import TABLE, Source, acked_through, run_once, spot, taken, wait_for


def test_latest_of_each_sensor_is_shown_and_the_rest_counted():
    sent = [published(number, sensor=name) for number in range(5) for name in ("front", "left")]
    with Publisher() as publisher, publisher.playing(sent), Live(publisher.address) as live:
        wait_for(lambda: live.skipped == len(sent) - 2)  # all have come
        shown = wait_for(live.take)
        assert sorted((each.image.stamp.sensor, each.image.stamp.sequence) for each in shown) == [
            ("front", 4),
            ("left", 4),
        ]
        assert (live.skipped, live.dropped, live.take()) == (8, 0, [])
        assert shown[0].pose.translation_m == Publisher.translation_m
        assert live.latency_s(shown) == pytest.approx(time.time() - 1_700_000_000.4, abs=60)


def view_of(source, **choices):
    return Viewer(source, port=0, choices=Choices(**choices))


def test_unset_clock_gives_no_age():
    """Images of other sensors beside it have an age."""
    unset, timed = (taken(spot(0, 2.0, timestamp_ns=at_ns)) for at_ns in (50_000_000, 1_700_000_000 * 10**9))
    with Live("tcp://127.0.0.1:1") as live:
        assert live.latency_s([unset]) is None
        assert live.latency_s([]) is None
        assert live.latency_s([unset, timed]) == pytest.approx(time.time() - 1_700_000_000, abs=60)


def test_fading_points_are_redrawn_without_new_images():
    source = Source()
    source.waiting = [taken(spot(0, 2.0), time_s=100.0)]
    with view_of(source, decay_s=0.5) as view:
        points = []
        for clock_s in (100.0, 100.3, 100.6):
            source.clock_s = clock_s
            acked_through(view)
            points.append(view._frame.sensors["front"])  # noqa: SLF001  what the page was given
        assert [len(each.position_m) for each in points] == [1, 1, 0]
        assert [each.share_left.tolist() for each in points[:2]] == [[1.0], pytest.approx([0.4])]
        assert view.shown == 1


def test_silent_sensor_is_marked():
    source = Source()
    poses = {"a": Pose((0.0, 0.3, 0.0)), "b": Pose((0.0, -0.3, 0.0))}
    source.waiting = [taken(spot(0, 2.0, sensor=name), pose, 100.0, 0.1) for name, pose in poses.items()]
    with view_of(source) as view:
        assert acked_through(view)["age"] == "a 0.0 s, b 0.0 s"
        assert view._frame.fused is not None  # noqa: SLF001
        source.clock_s = 3700.0
        source.waiting = [taken(spot(0, 2.0, sensor="a"), poses["a"], 3699.8, 0.1)]
        assert acked_through(view)["age"] == "a 0.2 s, b 3600 s (overdue)"
        frame = view._frame  # noqa: SLF001
        assert frame.fused is None
        assert frame.sensors["b"].picture.sum() < frame.sensors["a"].picture.sum()
        assert (frame.sensors["b"].colours < TABLE.max()).all()
        labels = {name: shown.label for name, shown in view._page._shown.items()}  # noqa: SLF001
        assert labels == {"a": "a", "b": "b (overdue)"}
        source.clock_s = 3702.0  # now both are silent
        assert acked_through(view)["age"] == "a 2.2 s (overdue), b 3602 s (overdue)"
        source.waiting = [taken(spot(0, 2.0, sensor="b"), poses["b"], 3702.0, 0.1)]
        assert acked_through(view)["age"] == "a 2.2 s (overdue), b 0.0 s"


def test_images_during_a_pause_are_counted():
    source = Source()

    def send(number):
        source.clock_s = 100 + number / 10
        source.waiting = [taken(spot(0, 2.0, sequence=number), time_s=source.clock_s, interval_s=0.1)]

    with view_of(source) as view:
        send(0)
        assert acked_through(view)["held"] == "0"
        view._orders.put(ControlRequest("play"))  # noqa: SLF001  as a browser does
        acked_through(view)
        for number in range(1, 25):
            send(number)
            run_once(view)
        reported = acked_through(view)
        assert (reported["held"], reported["frames"], reported["sequence"]) == ("24", "1", "0")
        assert (reported["state"], reported["age"]) == ("live, paused", "2.4 s")
        assert not view._frame.sensors["front"].overdue  # noqa: SLF001  a picture that is held stays as it is
        view._orders.put(ControlRequest("step", 1))  # noqa: SLF001
        acked_through(view)
        send(25)
        reported = acked_through(view)
        assert (reported["held"], reported["frames"], reported["sequence"]) == ("24", "2", "25")
        view._orders.put(ControlRequest("play"))  # noqa: SLF001
        acked_through(view)
        send(26)
        reported = acked_through(view)
        assert (reported["held"], reported["sequence"], reported["state"]) == ("24", "26", "live")
        assert source.received == view.shown + 24


def test_typical_interval_is_measured_from_arrivals():
    sent = [published(number) for number in range(5)]
    with Publisher() as publisher, publisher.playing(sent), Live(publisher.address) as live:
        wait_for(lambda: live.received == len(sent))
        (shown,) = wait_for(live.take)
        assert 0 < shown.interval_s < live.clock_s - shown.time_s + 60
        assert shown.time_s <= live.clock_s


def test_measurements_are_listed_in_the_order_of_the_pictures():
    source = Source()
    with view_of(source) as view:
        for number, name in enumerate(("right", "front", "left")):  # as they come
            source.waiting = [taken(spot(0, 2.0, sensor=name, sequence=7 + number), time_s=100.0)]
            reported = acked_through(view)
        assert reported["sequence"] == "front 8, left 9, right 7"
        shown = view._page._shown  # noqa: SLF001
        assert sorted(shown, key=lambda name: shown[name].order) == ["front", "left", "right"]


def test_state_shows_sending_sensors():
    source = Source()
    source.latency_s = lambda _: 0.025
    with view_of(source) as view:
        assert acked_through(view)["state"] == "connected, no sensor sends"
        source.waiting = [taken(spot(0, 2.0, sensor=name), time_s=100.0, interval_s=0.1) for name in "ab"]
        reported = acked_through(view)
        assert (reported["state"], reported["latency"]) == ("live", "25 ms")
        source.clock_s = 105.0
        source.waiting = [taken(spot(0, 2.0, sensor="a"), time_s=105.0, interval_s=0.1)]
        assert acked_through(view)["state"] == "live"
        source.clock_s = 110.0
        reported = acked_through(view)
        assert (reported["state"], reported["latency"]) == ("all sensors overdue", "–")
        source.connected, source.state = False, "waiting for the central node"
        assert acked_through(view)["state"] == "waiting for the central node"


DIRECTIONS = "sensor front has directions at one elevation"


def notes_of(live):
    """The next message to the user, if any."""
    return wait_for(live.notes)


def test_missing_publisher_is_reported_once(monkeypatch):
    monkeypatch.setattr(_live, "_SOON_S", 1000.0)
    with reserved_address() as address, Live(address) as live:
        assert live.notes() == []
        monkeypatch.setattr(_live, "_SOON_S", 0.2)
        assert notes_of(live) == [f"no publisher at {address} yet; is 'ertis serve' running?"]
        assert live.notes() == []
        with Publisher(address=address) as publisher, publisher.playing([published(0)]):
            wait_for(live.take)
            assert [note.partition(",")[0] for note in notes_of(live)] in (["connected"], ["connected", DIRECTIONS])


def test_unknown_sensors_are_reported(monkeypatch):
    reported = status(sensors={name: SensorStatus() for name in ("left", "front")})
    notes = []
    statuses = itertools.takewhile(lambda _: len(notes) < 2, itertools.repeat(reported, 20_000))
    with Publisher() as publisher, Live(publisher.address, sensors=["front", "nope"]) as live:
        with publisher.playing(statuses):
            wait_for(lambda: notes.extend(live.notes()) or notes)
            monkeypatch.setattr(_live, "_SOON_S", 0.0)
            wait_for(lambda: notes.extend(live.notes()) or len(notes) > 1)
        assert notes == ["connected", "no sensor 'nope' yet; choose one of front, left"]
        assert live.received == 0


def test_refusal_is_reported_once():
    """It is an error if the view subscribes at the address for sensors."""
    with Publisher(answers=False) as publisher, Live(publisher.address) as live:
        notes, failed = [], []

        def refuse():
            publisher.tell_all(Refused(code="role", reason="this is where sensors send to"))
            notes.extend(live.notes())
            try:
                live.take()
            except RefusedError as error:
                failed.append(str(error))
            return failed

        publisher.pump(refuse)
        assert failed == [f"{publisher.address}: this is where sensors send to"]
        assert notes + live.notes() == []


def come(view, source, number, *names, clock_s, moment=None):
    """Deliver images of some sensors for one time step."""
    source.clock_s = clock_s
    emitted_ns = round(1e18 + 0.2e9 * (number if moment is None else moment))
    source.waiting += [
        taken(spot(0, 2.0, sensor=name, sequence=number, timestamp_ns=emitted_ns), time_s=clock_s, interval_s=0.2)
        for name in names
    ]
    return acked_through(view)


def test_step_shows_all_sending_sensors():
    source = Source()
    with view_of(source) as view:
        come(view, source, 0, "a", "b", "dead", clock_s=100.0)
        view._orders.put(ControlRequest("play"))  # noqa: SLF001  as a browser does
        come(view, source, 20, "a", "b", clock_s=104.0)
        view._orders.put(ControlRequest("step", 1))  # noqa: SLF001
        reported = come(view, source, 21, "b", clock_s=104.2)  # of the moment before the one that follows
        assert (reported["sequence"], reported["held"]) == ("a 0, b 0, dead 0", "3")
        assert come(view, source, 22, "a", clock_s=104.3)["sequence"] == "a 0, b 0, dead 0"
        reported = come(view, source, 22, "b", clock_s=104.4)
        assert (reported["sequence"], reported["held"]) == ("a 22, b 22, dead 0", "3")
        assert reported["age"] == "a 0.1 s, b 0.0 s, dead 4.4 s (overdue)"
        come(view, source, 23, "a", "b", clock_s=104.6)
        assert acked_through(view)["sequence"] == "a 22, b 22, dead 0"


def test_step_does_not_wait_for_a_slow_sensor():
    source = Source()
    rare = [taken(spot(0, 2.0, sensor="rare", sequence=n), time_s=90.0 + 10 * n, interval_s=10.0) for n in range(3)]
    with view_of(source) as view:
        source.waiting = [rare[1]]
        come(view, source, 0, "a", clock_s=100.0)
        view._orders.put(ControlRequest("play"))  # noqa: SLF001  as a browser does
        source.waiting = [rare[2]]
        come(view, source, 50, "a", clock_s=110.0)
        source.clock_s = 140.0
        view._orders.put(ControlRequest("step", 1))  # noqa: SLF001
        come(view, source, 200, "a", clock_s=139.0)
        reported = come(view, source, 205, "a", clock_s=140.1)
        assert reported["sequence"] == "a 205, rare 2"  # the latest that has come of each
