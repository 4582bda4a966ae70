"""Subscribers that come late, are killed and come back disturb no other, and the publisher does not grow."""

import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.frames import Stamp
from ertis_numba.interop.ros_messages import MESSAGES
from ertis_numba.ros import Participant, RosPublisher
from tests.files import image
from tests.journals import ENVIRONMENT
from tests.ros_topics import DOMAIN, await_subscribers, subscribed

pytest.importorskip("rclpy.serialization")  # Wheels exist for some versions of Python only.
pytest.importorskip("cyclonedds")

N_PARTICIPANTS = 10
PERIOD_S = 0.02
MAX_GROWTH_BYTES = 30e6

GUESTS = f"""
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2

heard, contexts = set(), []
for number in range({N_PARTICIPANTS}):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(f"guest_{{number}}", context=context)
    node.create_subscription(PointCloud2, "/front/points", lambda _, number=number: heard.add(number), 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    contexts.append((context, node, executor))
told = False
while True:
    for *_, executor in contexts:
        executor.spin_once(timeout_sec=0.001)
    if len(heard) == {N_PARTICIPANTS} and not told:
        print("heard", flush=True)
        told = True
"""


def rss_bytes():
    statm = Path("/proc/self/statm").read_text("ascii")
    return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Publishing(threading.Thread):
    """Thread that publishes numbered points at a steady rate."""

    def __init__(self, ros):
        super().__init__()
        self._ros, self._cloud = ros, PointFinder()(image(seed=1))
        self._stop_asked = threading.Event()
        self.count = 0
        self.slowest_s = 0.0

    def run(self):
        while not self._stop_asked.wait(PERIOD_S):
            stamp = Stamp(sensor="front", sequence=self.count, timestamp_ns=10**18 + self.count)
            begun_s = time.perf_counter()
            self._ros.publish(self._cloud.replace(stamp=stamp))
            self.slowest_s = max(self.slowest_s, time.perf_counter() - begun_s)
            self.count += 1

    def stop(self):
        self._stop_asked.set()
        self.join()


def guests():
    environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
    return subprocess.Popen([sys.executable, "-c", GUESTS], env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM], ids=["killed", "ended"])
def test_participants_come_and_go_without_a_loss_for_others(how):
    kinds = {"/front/points": MESSAGES["points"]}
    with subscribed(kinds, domain=DOMAIN) as steady, Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant, topics=["points"])
        publishing = Publishing(ros)
        publishing.start()
        try:
            while not ros.topics:
                time.sleep(PERIOD_S)
            await_subscribers(ros.topics.values())
            first_bytes = rss_bytes()
            for _ in range(2):  # They leave, and come back.
                with guests() as process:
                    try:
                        assert process.stdout.readline() == "heard\n"
                    finally:
                        process.send_signal(how)
        finally:
            publishing.stop()
        assert rss_bytes() - first_bytes < MAX_GROWTH_BYTES
        numbers = [number_of(steady.take(1)["/front/points"][0])]
        while numbers[-1] < publishing.count - 1:
            numbers.append(number_of(steady.take(1)["/front/points"][0]))
    assert numbers == list(range(numbers[0], publishing.count))
    assert ros.dropped == 0
    assert publishing.count > 50


def number_of(message):
    """Number of a message, which is in the nanoseconds of its stamp."""
    return struct.unpack_from("<I", message, 8)[0]
