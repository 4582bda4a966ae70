"""``ertis record`` stores each acknowledged measurement exactly once, even if it is killed."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest
from click.testing import CliRunner
from ertis_cli._lines import JsonLines
from ertis_cli.main import cli

from ertis_numba.journal import SUFFIX
from ertis_numba.network.allow_list import AllowList
from ertis_numba.network.keys import KeyPair
from ertis_numba.network.messages import Ping
from tests.central import Node, stored, wanted
from tests.journals import ENVIRONMENT, TINY, entries

REPORTED = {
    *("event", "received", "stored", "missing", "recordings", "unsealed", "refused", "seconds", "ack", "commit"),
    "restarts",
    *("processing", "sensors"),
}


class Recording:
    """Process of ``ertis record`` whose events are read one at a time."""

    def __init__(self, folder, *options, environment=ENVIRONMENT, stderr=None):
        command = [sys.executable, "-m", "ertis_cli", "record", "--listen", "tcp://127.0.0.1:0", "-o", str(folder)]
        self.process = subprocess.Popen(
            [*command, "--json", "-q", *options], stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment
        )
        self.started = self.event("listening")
        self.address = self.started["address"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def event(self, name):
        for line in self.process.stdout:
            event = json.loads(line)
            if event["event"] == name:
                return event
        raise AssertionError(f"it ended with {self.process.wait()} without {name}")


@pytest.mark.alone
def test_record_listens_soon_after_its_start(tmp_path):
    begun_s = time.monotonic()
    with Recording(tmp_path):
        assert time.monotonic() - begun_s < 5.0  # It takes 0.3 s on an idle machine.


def test_killed_record_neither_loses_nor_repeats_acknowledged_data(tmp_path):
    given = entries(36, first=0)
    acked_through = -1
    for kill in range(3):
        with Recording(tmp_path, "--rotate-size", "1") as central, Node(central.address) as node:
            known = node.hello(first=acked_through + 1).acked_through
            assert known >= acked_through
            acked_through = known
            node.measure(*given[acked_through + 1 : 12 * (kill + 1)])
            acked_through = node.hear_settled(12 * kill + 5).acked_through
            central.process.send_signal(signal.SIGKILL)
    with Recording(tmp_path) as central, Node(central.address) as node:
        assert node.hello(first=acked_through + 1).acked_through >= acked_through
        node.measure(*given[acked_through + 1 :])
        node.send(Ping())
        node.hear_settled(35)
        central.process.send_signal(signal.SIGINT)
        reported = central.event("recorded")
        assert central.process.wait() == 0
    assert reported["unsealed"] == 0
    assert not list(tmp_path.glob(f"*{SUFFIX}"))
    assert sorted(stored(tmp_path)[0]) == sorted(wanted(given))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_record_cleanly(number, tmp_path):
    given = entries(3, first=0)
    with Recording(tmp_path, "--every", "--name", "tour") as central, Node(central.address) as node:
        node.hello(first=0)
        node.measure(*given)
        reported = [central.event("stored") for _ in given]
        central.process.send_signal(number)
        sealed = central.event("sealed")
        counts = central.event("recorded")
        assert central.process.wait() == 0
    assert [(each["sensor"], each["session_id"], each["sequence"]) for each in reported] == [
        each[0] for each in wanted(given)
    ]
    assert sealed["measurements"] == counts["stored"] == 3
    assert counts["recordings"] == [str(path) for path in tmp_path.glob("tour_*.h5")]
    assert stored(tmp_path)[0] == wanted(given)


def test_record_ends_after_its_duration(tmp_path):
    arguments = ["record", "--listen", "tcp://127.0.0.1:0", "-o", str(tmp_path / "new"), "--duration", "0.1"]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert "info listening address=tcp://127.0.0.1:" in result.stderr
    assert "0 measurements received, 0 missing" in result.stderr


@pytest.mark.parametrize(
    ("options", "message", "code"),
    [
        (["--rotate-size", "0"], "--rotate-size is 0; use a number from 1 to 1e+09", 2),
        (["--rotate-every", "0"], "--rotate-every is 0; use a number from 1 to 1e+09", 2),
        (["--name", "a/b"], "--name 'a/b' cannot name a group in a file; use letters", 2),
        (["--duration", "0"], "--duration is 0; use a number above 0", 2),
        (["--metrics", "foo"], "--metrics is 'foo'; use HOST:PORT, such as 127.0.0.1:9101", 2),
        (["--listen", "nonsense"], "error: --listen 'nonsense' cannot be used; use tcp://HOST:PORT", 2),
        (["--listen", "{taken}"], "is in use by another program; end that program or choose another --listen", 1),
        (["--metrics", "{taken}"], "cannot listen at", 1),
    ],
)
def test_refused_record_leaves_no_files(options, message, code, tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        taken = f"tcp://{taken}" if "--listen" in options else taken
        given = [option.format(taken=taken) for option in options]
        arguments = ["record", "-o", str(tmp_path / "new"), "--listen", "tcp://127.0.0.1:0", "-q", *given]
        result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == code
    (line,) = result.stderr.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


def test_refused_record_keeps_an_existing_folder(tmp_path):
    result = CliRunner().invoke(cli, ["record", "-o", str(tmp_path), "--listen", "tcp://10.1.1.1:5601", "-q"])
    assert result.exit_code == 1
    assert tmp_path.is_dir()


def test_record_reports_its_actual_address(tmp_path):
    pair = KeyPair.new("central")
    secret, _ = pair.save(tmp_path / "keys")
    AllowList().save(tmp_path / "keys" / "allow.toml")
    keys = ["--key", str(secret), "--allow", str(tmp_path / "keys" / "allow.toml")]
    arguments = ["record", "--listen", "tcp://0.0.0.0:0", "-o", str(tmp_path / "new"), "--duration", "0.1", *keys]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    assert re.search(r"info listening address=tcp://0\.0\.0\.0:[1-9]", result.stderr)


def test_max_bytes_option_admits_longer_measurements(tmp_path):
    settings = TINY.replace(recording=TINY.recording.replace(n_samples=8192))
    given = entries(1, first=0, settings=settings)
    n_bytes = given[0].measurement.data.nbytes
    for max_bytes in (n_bytes - 1, n_bytes):
        with Recording(tmp_path, "--max-bytes", str(max_bytes)) as central, Node(central.address) as node:
            answer = node.hello(first=0, settings=settings)
            if max_bytes < n_bytes:
                assert "(--max-bytes)" in answer.reason
                continue
            node.measure(*given)
            node.hear_settled(0)


def test_record_reports_the_same_status_as_serve(tmp_path):
    with Recording(tmp_path) as central, Node(central.address) as node:
        node.hello(first=2)
        node.measure(*entries(3, first=2))
        node.hear_settled(4)
        central.process.send_signal(signal.SIGINT)
        reported = central.event("recorded")
    assert set(reported) == REPORTED
    assert (reported["received"], reported["stored"], reported["missing"]) == (
        3,
        3,
        {"never reached the central node": 2},
    )
    assert reported["missing"] == reported["sensors"]["left"]["missing"]


def test_record_serves_metrics(tmp_path):
    arguments = ["record", "--listen", "tcp://127.0.0.1:0", "-o", str(tmp_path), "--duration", "0.1", "-q"]
    result = CliRunner().invoke(cli, [*arguments, "--metrics", "127.0.0.1:0"])
    assert result.exit_code == 0, result.output
    assert result.stderr == ""


def test_unread_events_do_not_block_record():
    reader, writer = os.pipe()
    with os.fdopen(writer, "w", encoding="utf-8") as stream:
        lines = JsonLines(stream, largest=1000)
        begun_s, begun_cpu_s = time.monotonic(), time.process_time()
        for number in range(100_000):
            lines.write(f"line {number}\n")
        assert time.process_time() - begun_cpu_s < 5.0
        assert time.monotonic() - begun_s < 60.0  # Waiting for the reader takes no processor time.
        assert 0 < lines.lost < 100_000
        os.set_blocking(reader, False)
        got = b""
        while b"line 999\n" not in got:  # Read the events only now.
            with contextlib.suppress(BlockingIOError):
                got += os.read(reader, 65_536)
        assert got.startswith(b"line 0\nline 1\n")
        lines.close()
    os.close(reader)
