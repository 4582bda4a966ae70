"""Metrics over HTTP as Prometheus reads them, and log lines."""

import http.client
import io
import json
import logging
import socket
import sys
import time
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.network import log
from ertis_numba.network._metrics_server import Handler
from ertis_numba.network.metrics import Metrics
from ertis_numba.network.status import Status
from tests.network.test_status import BUSY


def _scraped(address):
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=60) as answer:
        text = answer.read().decode()
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_metrics_report_the_present_status():
    now = [BUSY]
    with Metrics("127.0.0.1:0", lambda: now[0]) as metrics:
        values = _scraped(metrics.address)
        now[0] = Status(version="1", pid=7, host="here", address="tcp://127.0.0.1:5601", state="storage")
        after = _scraped(metrics.address)
    front = ("sensor", "front")
    assert values["ertis_received_total", front] == 41
    assert values["ertis_stored_total", front] == 40
    assert values["ertis_published_total", front] == 37
    assert values["ertis_passive_total", front] == 8
    assert values["ertis_connected", front] == 1
    assert values["ertis_connected", ("sensor", "left")] == 0
    assert values["ertis_dropped_total", ("reason", "superseded"), front] == 4
    assert values["ertis_missing_total", ("reason", "the spool was full"), front] == 5
    assert values["ertis_image_latency_seconds", ("quantile", "0.99"), front] == 0.04
    assert values["ertis_refused_total", ("reason", "unknown key")] == 3
    assert values["ertis_state", ("state", "fault")] == 1
    assert values["ertis_archive_room_bytes",] == 3_000_000_000
    assert values["ertis_archive_sealing_failed_total",] == 1
    assert values["ertis_workers",] == 1
    assert values["ertis_groups_total", ("kind", "complete")] == 9
    assert after["ertis_state", ("state", "storage")] == 1
    assert after["ertis_state", ("state", "fault")] == 0
    assert not any("sensor" in dict(labels) for _, *labels in after)


def test_metrics_server_ends():
    metrics = Metrics("127.0.0.1:0", lambda: BUSY)
    metrics.start()
    metrics.close()
    metrics.close()
    with pytest.raises(OSError, match="refused"):
        _scraped(metrics.address)


def test_metrics_close_connections_beyond_a_limit(monkeypatch):
    monkeypatch.setattr(Handler, "timeout", 60.0)  # Silent connections stay open for the length of the test.
    with Metrics("127.0.0.1:0", lambda: BUSY) as metrics:
        place = ("127.0.0.1", int(metrics.address.rpartition(":")[2]))
        silent = [socket.create_connection(place, timeout=60) for _ in range(16)]
        with socket.create_connection(place, timeout=60) as further:
            assert further.recv(1) == b""
        for each in silent:
            each.close()
        assert _eventually(lambda: _scraped(metrics.address))


def test_metrics_close_silent_connections(monkeypatch):
    monkeypatch.setattr(Handler, "timeout", 0.05)
    with Metrics("127.0.0.1:0", lambda: BUSY) as metrics:
        with socket.create_connection(("127.0.0.1", int(metrics.address.rpartition(":")[2])), timeout=60) as silent:
            assert silent.recv(1) == b""
        assert _scraped(metrics.address)


def _eventually(scrape):
    """Return what an attempt returns once the server has seen that connections are closed."""
    until_s = time.monotonic() + 60
    while True:
        try:
            return scrape()
        except OSError:
            if time.monotonic() > until_s:
                raise


@pytest.mark.parametrize("address", ["0.0.0.0:9101", "*:9101", "example.org:9101", "192.0.2.1:9101"])
def test_metrics_are_served_on_loopback_only(address):
    with pytest.raises(ArgumentError, match=r"can be reached from other machines; use 127\.0\.0\.1:PORT"):
        Metrics(address, lambda: BUSY)


def test_metrics_address_in_use_is_reported():
    with Metrics("127.0.0.1:0", lambda: BUSY) as first, pytest.raises(NetworkError, match="cannot listen at"):
        Metrics(first.address, lambda: BUSY).start()


def test_missing_prometheus_client_is_reported_with_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(ArgumentError, match=r"need prometheus-client .*; run \"pip install 'ertis-numba\[metrics\]'\""):
        Metrics("127.0.0.1:0", lambda: BUSY)


# Log lines


@pytest.fixture
def lines():
    stream = io.StringIO()
    root = logging.getLogger("ertis.network")
    before = root.handlers[:], root.level, root.propagate
    yield lambda **options: (log.show(stream=stream, **options), stream)[1]
    root.handlers[:], root.level, root.propagate = before


def test_event_is_one_parseable_line(lines):
    stream = lines()
    log.logger("central_node").warning(
        "conflict", sensor="front", session_id=7, sequence=41, text="both are kept", of=None
    )
    time, *rest = stream.getvalue().rstrip("\n").split(" ", 1)
    assert rest == ['warning conflict sensor=front session_id=7 sequence=41 text="both are kept"']
    assert len(time) == len("2026-11-22T04:31:00.123Z")
    assert time.endswith("Z")


def test_event_is_printed_as_json(lines):
    stream = lines(as_json=True)
    log.logger("central_node").error("fault", sensor="front", text='a "b"\nc')
    reported = json.loads(stream.getvalue())
    assert reported.pop("time").endswith("Z")
    assert reported == {"level": "error", "event": "fault", "sensor": "front", "text": 'a "b"\nc'}


@pytest.mark.parametrize("text", ["a\nb", "a=b", 'say "x"', "", "tab\t", "\x1b[31m", "\u2028line"])
def test_foreign_text_stays_in_its_field(lines, text):
    stream = lines()
    log.logger("central_node").info("refused", text=text)
    (line,) = stream.getvalue().splitlines()
    assert json.loads(line.partition("text=")[2]) == text
    assert line.isprintable()


def test_events_below_the_level_are_hidden(lines):
    stream = lines(level="WARNING")
    log.logger("central_node").info("joined", sensor="front")
    log.logger("central_node").debug("turn")
    assert not stream.getvalue()


@pytest.mark.parametrize(
    ("host", "code"),
    [
        ("localhost", 200),
        ("LOCALHOST:1", 200),
        ("127.0.0.1:9101", 200),
        ("[::1]:9101", 200),
        ("evil.example", 421),
        ("evil.example:9101", 421),
        ("127.0.0.1.evil.example", 421),
        ("localhost.evil.example", 421),
        ("192.168.0.7", 421),
        ("", 421),
        ("localhost, evil.example", 421),
    ],
)
def test_metrics_are_served_to_loopback_hosts_only(host, code):
    with Metrics("127.0.0.1:0", lambda: BUSY) as metrics:
        connection = http.client.HTTPConnection(metrics.address, timeout=60)
        connection.putrequest("GET", "/metrics", skip_host=True)
        connection.putheader("Host", host)
        connection.endheaders()
        answer = connection.getresponse()
        text = answer.read()
    assert answer.status == code
    assert (b"ertis_node" in text) == (code == 200)
