"""Subscribers of rclpy in processes of their own, for tests of ROS 2 topics."""

import base64
import fcntl
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

from tests.journals import ENVIRONMENT

N_DOMAINS = 101  # The ports of higher domains may be in use by clients of any protocol.
WAIT_S = 60.0


def own_domain():
    """Return a domain that no other running test uses: its file is locked until this process ends."""
    for domain in range(1, N_DOMAINS):
        path = Path(tempfile.gettempdir()) / f"ertis-test-domain-{os.getuid()}-{domain}.lock"
        lock = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
        else:
            return domain
    raise AssertionError("all domains are in use")


DOMAIN, OTHER_DOMAIN = own_domain(), own_domain()


class Subscriber:
    """Subscriber of rclpy; its messages arrive as (topic, bytes)."""

    def __init__(self, process):
        self._process = process

    def pause(self):
        """Stop the process, as a debugger does."""
        self._process.send_signal(signal.SIGSTOP)

    def take_after(self, time_ns):
        """Return the bytes of the next message that arrives after a time."""
        while (line := self._line())["received_ns"] < time_ns:
            pass
        return base64.b64decode(line["cdr"])

    def take(self, count):
        """Next messages, as a dict of topic to a list of their bytes."""
        taken = {}
        for number in range(count):
            line = self._line()
            assert line, f"{number} of {count} messages arrived: { {name: len(each) for name, each in taken.items()} }"
            taken.setdefault(line["topic"], []).append(base64.b64decode(line["cdr"]))
        return taken

    def _line(self):
        """Return what the process prints next; {} if it prints nothing for a minute, which ends it."""
        timer = threading.Timer(WAIT_S, self._process.kill)
        timer.start()
        line = self._process.stdout.readline()
        timer.cancel()
        return json.loads(line or "{}")


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
