"""Subscribers of rclpy in processes of their own, for tests of ROS 2 topics."""

import base64
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager

from tests.journals import ENVIRONMENT

DOMAIN = 1 + os.getpid() % 200  # Tests that run at the same time have their own domains.
WAIT_S = 30.0


class Subscriber:
    """Subscriber of rclpy; its messages arrive as (topic, bytes)."""

    def __init__(self, process):
        self._process = process

    def pause(self):
        """Stop the process, as a debugger does."""
        self._process.send_signal(signal.SIGSTOP)

    def take(self, count):
        """Next messages, as a dict of topic to a list of their bytes."""
        taken = {}
        for _ in range(count):
            line = json.loads(self._process.stdout.readline())
            taken.setdefault(line["topic"], []).append(base64.b64decode(line["cdr"]))
        return taken


@contextmanager
def subscribed(topics, *, domain=DOMAIN):
    command = [sys.executable, "-m", "tests.ros_subscriber", *(f"{name}={kind}" for name, kind in topics.items())]
    environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": tempfile.gettempdir()}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            assert json.loads(process.stdout.readline()) == {"ready": True}
            yield Subscriber(process)
        finally:
            process.kill()


def await_subscribers(topics, count=1):
    """Wait until each topic has subscribers."""
    end_s = time.monotonic() + WAIT_S
    while any(topic.n_subscribers < count for topic in topics):
        assert time.monotonic() < end_s
        time.sleep(0.01)
