"""Processing in an event loop: each measurement is published, in progress, or dropped with a reason."""

import dataclasses
import os
import signal
import sys
import threading
import time
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from ertis_numba.analysis.points import PointExtractor
from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.geometry import self_contained
from ertis_numba.network.messages import Points, Raw
from ertis_numba.network.processing import ImageProcessing, ProcessingOptions
from ertis_numba.network.processing._predictions import Predictions
from ertis_numba.network.processing.shared_slots import SlotPool
from ertis_numba.network.status import Status
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air
from tests import cases
from tests.driven import ANY, MEASUREMENT, SHORT, Application, driven, hello
from tests.files import echoes

WIDE = SHORT.replace(processing=SHORT.processing.replace(directions="2d:9"))


@pytest.fixture(scope="module")
def cpu_loop():
    with driven(device="cpu") as loop:
        yield loop


@pytest.mark.filterwarnings("ignore::ertis_numba.base.errors.CallMismatchWarning")  # Eight microphones hear little.
def test_published_products_equal_those_of_the_pipeline(cpu_loop):
    loop = cpu_loop.fresh()
    (measurement,) = echoes(SHORT, 1, [(0.0, 0.45)])
    place = {"translation_m": (1.0, 2.0, 3.0), "rotation_xyzw": (0.0, 0.0, 1.0, 0.0)}
    with Application(loop.processing.address) as application:
        application.subscribe("energyscape", "points", "raw", credit=8)
        loop.until(lambda: loop.processing.status().subscribers)
        loop.processing.register(hello(**place), SHORT)
        loop.offer(words=measurement.data)
        loop.until(lambda: application.read() or len(application.got) == 3)
    assert application.kinds() == ["Image", "Points", "Raw"]
    with Pipeline(SHORT, device="cpu") as pipeline:
        wanted = pipeline.process(measurement)
    (image, amplitude), (points, cloud), (raw, words) = application.got
    assert np.array_equal(np.frombuffer(amplitude, "<f4").reshape(image.shape), wanted.amplitude)
    assert words == measurement.data.tobytes()
    extracted = PointExtractor(wanted.settings)(wanted)
    rows = np.frombuffer(cloud, "<f4").reshape(points.n_points, 4)
    assert len(rows) > 0
    assert np.array_equal(rows[:, :3], extracted.position_m)
    assert np.array_equal(rows[:, 3], extracted.amplitude)
    description, settings, (azimuth, elevation, range_m) = application.descriptions[image.description]
    assert settings == self_contained(wanted.settings)
    assert np.array_equal(np.frombuffer(azimuth), wanted.azimuth_rad)
    assert np.array_equal(np.frombuffer(elevation), wanted.elevation_rad)
    assert np.array_equal(np.frombuffer(range_m), wanted.range_m)
    assert (description.sensor, description.translation_m) == ("front", place["translation_m"])
    assert description.rotation_xyzw == place["rotation_xyzw"]
    description, settings, axes = application.descriptions[raw.description]
    assert (settings, axes) == (SHORT, [b"", b"", b""])
    assert image.received_ns < image.published_ns < time.monotonic_ns()


def test_measurements_without_a_call_are_published_without_images(loop):
    with Application(loop.processing.address) as application:
        application.subscribe("energyscape", "raw", sensors=("mixed",), credit=16)
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello("mixed"), SHORT)
        loop.offer("mixed", behaviour="active")
        loop.settle()  # A pipeline is ready.
        for behaviour in ("active", "passive", "active"):
            loop.offer("mixed", behaviour=behaviour)
            loop.settle()
        loop.until(lambda: application.read() or len(application.got) == 7)
    assert application.kinds() == ["Image", "Raw", "Image", "Raw", "Raw", "Image", "Raw"]
    assert [header.behaviour for header, _ in application.got].count("passive") == 1
    assert [header.number for header, _ in application.got] == list(range(7))  # Nothing is missing.
    assert all(words == MEASUREMENT.data.tobytes() for header, words in application.got if isinstance(header, Raw))
    counts = loop.processing.counts("mixed")
    assert (counts.received, counts.published, counts.passive, counts.dropped.total()) == (4, 4, 1, 0)


def test_measurements_without_a_call_wait_for_earlier_images(loop):
    with Application(loop.processing.address) as application:
        application.subscribe("raw", sensors=("behind",), credit=16)
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello("behind"), SHORT)
        loop.offer("behind", behaviour="active")
        loop.settle()
        loop.offer("behind", behaviour="active")  # A worker begins with it.
        loop.offer("behind", behaviour="passive")
        loop.settle()
        loop.until(lambda: application.read() or len(application.got) == 3)
    sequences = [raw.sequence for raw, _ in application.got]
    assert sequences == sorted(sequences)


def test_sensors_without_calls_need_no_worker():
    """They are logged once, also if no pipeline could be made for their settings."""
    long = SHORT.replace(processing=SHORT.processing.replace(range_m=(0.3, 500.0)))
    maps = SHORT.replace(processing=SHORT.processing.replace(mode="passive"))
    with driven() as loop, Application(loop.processing.address) as application:
        application.subscribe("raw", credit=64)
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello("long", long), long)
        loop.processing.register(hello("maps", maps), maps)
        loop.until(lambda: any(event == "unusable" for event, _ in loop.lines))
        for count in range(2, 42, 2):
            loop.offer("long", settings=long, behaviour="passive")
            loop.offer("maps", settings=maps, behaviour="active")
            loop.until(lambda count=count: application.read() or len(application.got) == count)
        loop.settle()
        for sensor in ("long", "maps"):
            counts = loop.processing.counts(sensor)
            assert (counts.published, counts.passive, counts.dropped.total()) == (20, 20, 0)
        assert sum(worker.done for worker in loop.processing.status().workers) == 0
    assert [fields["sensor"] for event, fields in loop.lines if event == "passive"] == ["long", "maps"]
    assert [fields["sensor"] for event, fields in loop.lines if event == "unusable"] == ["long"]


def test_measurements_without_a_call_are_dropped_with_a_dead_publisher():
    with driven() as loop:
        loop.processing.register(hello(), SHORT)
        os.kill(loop.processing.status().publisher_pid, signal.SIGKILL)
        loop.until(lambda: loop.processing.status().publisher_pid == 0)
        for _ in range(5):
            loop.offer(behaviour="passive")
        assert loop.processing.counts("front").dropped == {"superseded": 3}
        loop.settle()
        assert loop.processing.counts("front").published == 2


def test_slots_are_used_again_and_are_limited():
    pool = SlotPool(range(2))
    first, second = pool.take(100, 0), pool.take(5000, 0)
    assert pool.take(100, 0) is None
    pool.release(first)
    assert pool.take(50, 0) is first
    pool.release(first)
    larger = pool.take(9000, 0)
    assert (larger.number, larger.words_bytes) == (first.number, 9000)
    pool.release(second)
    assert pool.take(100, 0) is second
    pool.close()


@pytest.mark.parametrize("dtype", ["float16", "uint8"])
def test_options_override_settings_of_a_sensor(dtype):
    with (
        driven(processing={"directions": "2d:5"}, max_error_db=-30.0, dtype=dtype) as loop,
        Application(loop.processing.address) as application,
    ):
        application.subscribe("energyscape")
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello(), SHORT)
        loop.offer()
        loop.until(lambda: application.read() or application.got)
    ((image, amplitude),) = application.got
    assert image.shape[0] == 5
    applied = application.descriptions[image.description][1]
    assert (applied.processing.directions, applied.accuracy.max_error_db) == ("2d:5", -30.0)
    with Pipeline(applied, device="numpy") as pipeline:
        wanted = pipeline.process(MEASUREMENT).amplitude
    assert image.dtype == dtype
    if dtype == "float16":
        assert image.floor_db is image.step_db is None
        assert np.array_equal(np.frombuffer(amplitude, "<f2").reshape(image.shape), wanted.astype(np.float16))
    else:
        code = np.frombuffer(amplitude, np.uint8).reshape(image.shape)
        level_db = image.floor_db + (code - 1.0) * image.step_db
        assert np.abs(level_db - 20 * np.log10(wanted))[code > 0].max() <= 0.251
        assert (wanted[code == 0] < 10 ** ((image.floor_db - 0.249) / 20)).all()


def test_overload_drops_the_oldest_and_counts_each():
    with driven() as loop:
        for sensor in ("a", "b"):
            loop.processing.register(hello(sensor), SHORT)
        for _ in range(30):  # No worker is ready yet.
            loop.offer("a")
        assert loop.processing.counts("a").dropped == {"the workers were getting ready": 28}
        assert (loop.processing.counts("a").queue, loop.processing.counts("a").in_flight) == (2, 2)
        loop.until(lambda: loop.processing.counts("a").published == 2)
        offered = {"a": 30, "b": 0}
        while offered["a"] < 430 or min(loop.processing.counts(sensor).published for sensor in offered) <= 2:
            for sensor in "aaaabaaaab":  # One worker cannot process as many per step.
                loop.offer(sensor)
                offered[sensor] += 1
            loop.step()
        loop.settle()
        status = loop.processing.status()
        for sensor, received in offered.items():
            counts = loop.processing.counts(sensor)
            assert counts.received == received
            assert counts.published + counts.dropped.total() == received
            assert counts.published > 2  # Workers alternate between sensors.
            assert counts.dropped["superseded"] > 0
        assert sum(worker.done for worker in status.workers) == sum(
            loop.processing.counts(sensor).published for sensor in offered
        )
        assert status.process_time.p50_ms > 0
        assert loop.processing.counts("a").latency.p50_ms > 0


def test_two_workers_publish_in_order():
    with driven(workers=2) as loop, Application(loop.processing.address) as application:
        application.subscribe("energyscape", credit=64)
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello(), SHORT)
        loop.until(lambda: len(loop.workers("idle")) == 2)
        chosen = loop.processing._runner._chosen  # noqa: SLF001  a sustained load also selects it
        chosen.mode = chosen.modes[-1]
        for _ in range(40):
            loop.offer()
            loop.step()
        loop.settle()
        published = loop.processing.counts("front").published
        done = [worker.done for worker in loop.processing.status().workers]
        loop.until(lambda: application.read() or len(application.got) == published)
    assert min(done) > 0
    sequences = [image.sequence for image, _ in application.got]
    assert sequences == sorted(sequences)


def test_changed_settings_count_waiting_measurements(loop):
    with Application(loop.processing.address) as application:
        application.subscribe("energyscape", credit=8)
        loop.until(lambda: application.read() or application.others)
        loop.processing.register(hello("changed"), SHORT)
        loop.offer("changed")
        loop.settle()
        loop.offer("changed")
        loop.offer("changed")
        loop.processing.register(hello("changed", WIDE), WIDE)
        loop.offer("changed")
        loop.settle()
        warmer = Air(temperature_c=35.0)
        loop.offer("changed", temperature_c=warmer.temperature_c)  # Other air needs a pipeline of its own.
        loop.offer("changed", temperature_c=float("nan"))
        loop.settle()
        counts = loop.processing.counts("changed")
        loop.until(lambda: application.read() or len(application.got) == counts.published)
    assert counts.received == 6
    assert counts.dropped["its settings cannot be used"] == 1
    assert counts.dropped["the settings of its sensor changed"] in {1, 2}
    described = [application.descriptions[image.description] for image, _ in application.got]
    ((_, first, _), *_, (_, other, (_, _, cold)), (_, warm, (_, _, hot))) = described
    assert (first.processing.directions, other.processing.directions) == ("2d:7", "2d:9")
    assert warm.air.temperature_c == 35.0
    assert np.frombuffer(hot)[-1] > np.frombuffer(cold)[-1]


def test_measurements_in_progress_at_the_end_are_counted():
    with driven() as loop:
        loop.processing.register(hello(), SHORT)
        loop.offer()
        loop.offer()
    counts = loop.processing.counts("front")
    assert (counts.received, counts.in_flight, counts.dropped) == (2, 0, {"the central node ended": 2})


def test_stop_waits_for_measurements_in_progress():
    with driven() as loop:
        loop.processing.register(hello(), SHORT)
        loop.offer()
        loop.processing.close(60.0)
    assert loop.processing.counts("front").published == 1


def test_occupied_address_is_reported_in_one_line(loop):
    other = ImageProcessing(ProcessingOptions(publish=loop.processing.address, device="numpy"))
    with pytest.raises(NetworkError, match="is in use by"):
        other.start()


def test_stopped_start_returns_before_the_publisher_listens():
    processing = ImageProcessing(ProcessingOptions(publish=ANY, device="numpy"))
    try:
        processing.start(lambda: True)
        assert processing.address == ANY
    finally:
        processing.close()


def test_status_reaches_requests_and_subscriptions(loop):
    with Application(loop.processing.address) as application:
        application.subscribe("status")
        loop.until(lambda: application.read() or application.others)
        status = Status(version="1", pid=1, host="here", address="x", state="processing")
        status.processing = loop.processing.status()
        loop.processing.publish_status(status)
        loop.until(lambda: application.read() or application.got)
    ((_, payload),) = application.got
    assert msgspec.msgpack.decode(payload, type=Status) == status


def left_again(loop, application):
    """Offer another measurement; a subscription expires if a busy machine stops this process for seconds."""
    loop.offer("left")
    loop.settle()
    application.read()
    return application.got


def test_points_are_computed_only_for_subscribers(loop):
    with Application(loop.processing.address) as application:
        application.subscribe("points", sensors=("left",))
        loop.until(lambda: loop.processing.status().subscribers)
        for sensor in ("left", "right"):
            loop.processing.register(hello(sensor), SHORT)
            loop.offer(sensor)
        loop.settle()
        assert loop.processing.counts("right").published == 1
        loop.until(lambda: left_again(loop, application))
    assert {(type(message), message.sensor) for message, _ in application.got} == {(Points, "left")}


def test_image_is_independent_of_the_number_of_threads():
    with Pipeline(SHORT, device="cpu") as pipeline:
        wanted = pipeline.process(MEASUREMENT)
        assert np.array_equal(pipeline.process(MEASUREMENT, threads=1).amplitude, wanted.amplitude)
        with pytest.raises(ArgumentError, match="threads is 0"):
            pipeline.process(MEASUREMENT, threads=0)
        assert np.array_equal(pipeline.process(MEASUREMENT).amplitude, wanted.amplitude)


@pytest.mark.parametrize("changes", [{}, {"clean_within_db": 1.0, "weighting": "coherence_factor"}])
def test_missed_error_budget_is_logged_once_per_sensor(cpu_loop, changes):
    """Cleaning does not change the prediction, which is that of the whole image."""
    loop = cpu_loop.fresh()
    settings = cases.SHORT.replace(processing=cases.SHORT.processing.replace(**changes))
    words = cases.noise(settings).data
    silence = np.zeros_like(words)
    silence[::2] = ~silence[::2]
    for sensor in ("loud", "quiet"):
        loop.processing.register(hello(sensor, settings), settings)
    for _ in range(3):
        loop.offer("loud", words)
        loop.offer("quiet", silence)
        loop.settle()
    loop.until(lambda: any(event == "error_budget" for event, _ in loop.lines))
    found = [fields for event, fields in loop.lines if event == "error_budget"]
    assert [fields["sensor"] for fields in found] == ["quiet"]
    assert found[0]["text"].startswith("no echo was heard above the noise; most of the image is the error of the plan")


def test_sound_is_checked_ever_more_rarely(cpu_loop):
    """The first measurement may be silent, and the start of records may drift; other settings begin anew."""
    loop, found = cpu_loop.fresh(), []
    for kind in (1, 2):
        for number in range(1, 10):
            job = SimpleNamespace(data=SimpleNamespace(sensor="left"), kind=SimpleNamespace(number=kind))
            loop.processing._choose_checks(job)  # noqa: SLF001  a worker would take minutes
            found += [(kind, number, job.predict)] * job.check_sound
    assert found == [(kind, number, number == 1) for kind in (1, 2) for number in (1, 2, 4, 8)]


@pytest.mark.parametrize("is_paper", [True, False])
def test_images_of_no_plan_and_silence_are_not_predicted(is_paper):
    method = "paper" if is_paper else "fast"
    settings = SHORT.replace(processing=SHORT.processing.replace(method=method, directions="2d:31"))
    measurement = MEASUREMENT if is_paper else dataclasses.replace(MEASUREMENT, data=np.zeros_like(MEASUREMENT.data))
    with Pipeline(settings, predict=False) as pipeline:
        image = pipeline.process(dataclasses.replace(measurement, settings=settings))
    if not is_paper:
        image = image.replace(amplitude=np.zeros_like(image.amplitude))
    predictions = Predictions("cpu")
    predictions.add("sensor", image, measurement)
    found = predictions.drain()
    while predictions.busy:
        found += predictions.drain()
    assert found == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has priorities of threads")
def test_checks_have_a_lower_priority_than_images(monkeypatch):
    found = []
    monkeypatch.setattr(
        Predictions,
        "_report_sound",
        lambda *_: found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id())),
    )
    predictions = Predictions("cpu")
    predictions.add("sensor", None, MEASUREMENT)
    while predictions.busy:
        predictions.drain()
    assert found == [10] != [os.getpriority(os.PRIO_PROCESS, threading.get_native_id())]
