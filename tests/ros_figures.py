"""Figures of ``ertis ros``: times from sensors to callbacks of rclpy, and times of publish calls.

Four emulated sensors measure, and ``ertis ros`` publishes their points and scans. A program with rclpy subscribes to
all topics, and takes the time of each callback. Times count from the arrival of the first byte of a measurement, so
that they include its transfer over a pseudo terminal.
"""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np
from ertis_bench import machine, markdown

from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.ros import Participant, RosPublisher
from ertis_numba.settings import Settings
from tests.journals import ENVIRONMENT

ERTIS = (sys.executable, "-m", "ertis_cli")
RECORDING = Path(__file__).parents[1] / "data" / "synthetic" / "reflectors.h5"
DOMAIN = 101
ROS = ENVIRONMENT | {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
MARKER = "python -m tests.ros_figures"
WARM_UP_S = 10.0  # The first images compile kernels, and subscribers have to be found.
"""Time at the beginning that is left out."""

SUBSCRIBER = """
import json, struct, sys, time
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan, PointCloud2
import signal

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node, found = Node("figures"), {}

def noting(topic):
    def note(data, info):
        now_ns = time.time_ns()
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        number = info["publication_sequence_number"]
        found.setdefault(topic, []).append((seconds * 10**9 + nanoseconds, now_ns, number))
    return note

for topic in sys.argv[1:]:
    kind = PointCloud2 if topic.endswith("points") else LaserScan
    node.create_subscription(kind, topic, noting(topic), QoSProfile(depth=10), raw=True)
print("ready", flush=True)
signal.signal(signal.SIGINT, lambda *_: ended.append(True))
ended = []
while not ended:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps(found))
"""


@contextlib.contextmanager
def ended(command, how=signal.SIGINT, **options):
    """Run a process, and interrupt it at the end."""
    with subprocess.Popen(command, env=ROS, text=True, **options) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(how)


def latencies(duration_s, n_sensors, rate_hz, preset):
    """Return the counts of messages, and the latencies of callbacks in ms by topic."""
    names = [f"s{number}" for number in range(n_sensors)]
    topics = [f"/{name}/{topic}" for name in names for topic in ("points", "scan")]
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        for name in names:
            emulate = [*ERTIS, "sensors", "emulate", RECORDING, "--link", Path(folder) / name, "--quiet"]
            stack.enter_context(ended(emulate, stdout=subprocess.DEVNULL))
        ports = [str(Path(folder) / name) for name in names]
        await_ports(ports)
        options = {"stdout": subprocess.PIPE}
        subscriber = stack.enter_context(ended([sys.executable, "-c", SUBSCRIBER, *topics], **options))
        assert subscriber.stdout.readline() == "ready\n"
        command = ["ros", *ports, "--preset", preset, "--trigger-rate", str(rate_hz), "--domain", str(DOMAIN), "--json"]
        command += ["--duration", str(duration_s + WARM_UP_S)]
        with subprocess.Popen([*ERTIS, *command], env=ENVIRONMENT, text=True, **options) as ros:
            lines = [json.loads(line) for line in ros.stdout]
        time.sleep(1.0)
        subscriber.send_signal(signal.SIGINT)
        found = json.loads(subscriber.stdout.read())
    end = lines[-1]
    record_ns = round(1e9 * Settings.from_preset(preset).recording.duration_s)
    first_ns = min(times[0][1] for times in found.values()) + round(1e9 * WARM_UP_S)
    late_ms = {
        topic: [(came_ns - stamp_ns - record_ns) / 1e6 for stamp_ns, came_ns, _ in times if came_ns >= first_ns]
        for topic, times in found.items()
    }
    # Messages before the subscription was found are not lost.
    lost = {topic: times[-1][2] - times[0][2] + 1 - len(times) for topic, times in found.items()}
    assert lost.keys() == set(topics)
    assert all(times[-1][2] == end["messages"][topic] for topic, times in found.items()), "the last one is missing"
    return lines, lost, late_ms


def await_ports(ports):
    end_s = time.monotonic() + 60.0
    while not all(Path(port).exists() for port in ports):
        assert time.monotonic() < end_s, "the emulators do not start"
        time.sleep(0.05)


def publish_ms(topic, item, n=400):
    """Return the median time of a publish call with one subscriber, in ms."""
    options = {"stdout": subprocess.PIPE}
    name = f"/front/{topic}"
    with (
        ended([sys.executable, "-c", SUBSCRIBER, name], **options) as subscriber,
        Participant(domain=DOMAIN) as participant,
    ):
        assert subscriber.stdout.readline() == "ready\n"
        ros = RosPublisher(participant, topics=[topic])
        ros.publish(item)
        while topic == "points" and ros.topics[name].n_subscribers < 1:
            time.sleep(0.01)
        times_ms = []
        for _ in range(n):
            begun_s = time.perf_counter()
            ros.publish(item)
            times_ms.append(1e3 * (time.perf_counter() - begun_s))
            time.sleep(0.01)
        subscriber.send_signal(signal.SIGINT)
        subscriber.stdout.read()
    return float(np.median(times_ms)), float(np.percentile(times_ms, 99))


def cloud(n_points=256):
    position_m = np.random.default_rng(1).uniform(0.5, 3.0, (n_points, 3)).astype(np.float32)
    stamp = Stamp(sensor="front", timestamp_ns=time.time_ns())
    return PointCloud(position_m, np.ones(n_points, np.float32), Settings(), stamp)


def planar_image():
    """Return an image of 181 directions and 1178 ranges."""
    amplitude = np.random.default_rng(2).random((181, 1178), dtype=np.float32)
    azimuth_rad = np.radians(np.arange(-90.0, 91.0))
    return Energyscape(
        amplitude=amplitude,
        azimuth_rad=azimuth_rad,
        elevation_rad=np.zeros(181),
        range_m=np.linspace(0.5, 5.0, 1178),
        settings=Settings(),
        stamp=Stamp(sensor="front", timestamp_ns=time.time_ns()),
    )


@click.command()
@click.option("--duration", "duration_s", default=300.0, show_default=True, help="Seconds.")
@click.option("--sensors", "n_sensors", default=4, show_default=True)
@click.option("--rate", "rate_hz", default=20.0, show_default=True, help="Measurements of each sensor per second.")
@click.option("--preset", default="short_25_50", show_default=True)
@click.option("--update", "targets", multiple=True, type=click.Path(path_type=Path, exists=True), metavar="FILE")
def main(duration_s, n_sensors, rate_hz, preset, targets):
    """Measure times from sensors to callbacks of rclpy, and times of publish calls."""
    for target in targets:
        markdown.around(target, MARKER)
    lines, lost, late_ms = latencies(duration_s, n_sensors, rate_hz, preset)
    p50, p99, most = np.percentile(np.concatenate([*late_ms.values()]), [50, 99, 100])
    messages, n_images = lines[-1]["messages"], lines[-1]["measurements"]
    load = f"{n_sensors} sensors at {rate_hz:g} Hz for {duration_s:g} s"
    rows = [
        (f"{load}: messages", f"{sum(messages.values()):,} of {n_images:,} images, {sum(lost.values())} lost"),
        ("first byte of a measurement to callback", f"p50 {p50:.1f} ms, p99 {p99:.1f} ms, slowest {most:.1f} ms"),
    ]
    for label, topic, item in (
        ("256 points", "points", cloud()),
        ("image of 181 × 1178 in 8 bits", "image", planar_image()),
    ):
        p50, p99 = publish_ms(topic, item)
        rows.append((f"publish call, {label}", f"p50 {p50:.2f} ms, p99 {p99:.2f} ms"))
    notes = "; ".join(line["text"] for line in lines if line["event"] == "note")
    options = f"--duration {duration_s:g} --sensors {n_sensors} --rate {rate_hz:g} --preset {preset}"
    text = markdown.table(("figure", "measured"), rows)
    text += f"\n\nCommand: `python -m tests.ros_figures {options}`. {notes and notes + '. '}"
    text += machine.sentence(machine.describe())
    click.echo(text)
    for target in targets:
        markdown.update(target, MARKER, text)


if __name__ == "__main__":
    main()
