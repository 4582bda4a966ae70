"""Prometheus metrics of a central node."""

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Self

from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.base.extras import extra
from ertis_numba.network import addresses
from ertis_numba.network.status import Percentiles, Status

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

    from prometheus_client.core import Metric

__all__ = ["Metrics"]

_STATES: Final = ("storage", "processing", "fault", "closing")
_QUANTILES: Final = (("0.5", "p50_ms"), ("0.9", "p90_ms"), ("0.99", "p99_ms"), ("1", "max_ms"))
_OF_SENSOR: Final = {
    "received": "Measurements received, each counted once",
    "received_bytes": "Bytes of measurements received",
    "stored": "Measurements stored on disk",
    "published": "Measurements published",
    "passive": "Measurements without a call, published without an image",
    "repeated": "Duplicate measurements received",
    "conflicts": "Duplicates that differ from the stored measurement",
}
_NOW_OF_SENSOR: Final = {
    "connected": "1 if the sensor node is connected",
    "rate_hz": "Measurements per second",
    "in_flight": "Measurements being processed",
    "queue": "Measurements waiting",
    "acked_through": "Highest sequence number acknowledged through",
}


class Metrics:
    """HTTP server of a central node's status as metrics, on this machine; refuses other Hosts with 421."""

    # Port 0 of the address selects a free one, which `address` shows after the start.

    def __init__(self, address: str, latest: Callable[[], Status]) -> None:
        with extra("metrics", "metrics need prometheus-client"):
            import prometheus_client  # noqa: F401, PLC0415  an extra
        endpoint = addresses.endpoint(f"tcp://{address}")
        if not addresses.is_loopback(endpoint):
            raise ArgumentError(f"metrics address {address!r} can be reached from other machines; use 127.0.0.1:PORT")
        self.address = address
        self._host, self._port = addresses.host_of(endpoint), endpoint.rpartition(":")[2].replace("*", "0")
        self._latest = latest
        self._server: Any = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start serving."""
        from prometheus_client import CollectorRegistry, make_wsgi_app  # noqa: PLC0415  an extra

        from ertis_numba.network._metrics_server import Handler, Server  # noqa: PLC0415  only metrics need HTTP

        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        try:
            self._server = Server((self._host, int(self._port)), Handler)
        except OSError as error:
            raise NetworkError(f"cannot listen at {self.address} ({error.strerror}); choose another address") from error
        self._server.set_app(_of_own_hosts(make_wsgi_app(registry), self._host))
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        self.address = f"{self.address.rpartition(':')[0]}:{self._server.server_port}"

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        if self._thread is not None:
            self._thread.join()
        self._server = self._thread = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def describe(self) -> "list[Metric]":
        """Return nothing: the set of metrics is known only at each request."""
        return []

    def collect(self) -> "Iterator[Metric]":
        """Yield the metrics, in the form of Prometheus."""
        from prometheus_client.core import (  # noqa: PLC0415  an extra
            CounterMetricFamily,
            GaugeMetricFamily,
            InfoMetricFamily,
        )

        def counter(name: str, text: str, rows: Mapping[Any, float], *labels: str) -> "Metric":
            family = CounterMetricFamily(f"ertis_{name}", text, labels=labels)
            for values, value in rows.items():
                family.add_metric(values, value)
            return family

        def gauge(name: str, text: str, rows: Mapping[Any, float], *labels: str) -> "Metric":
            family = GaugeMetricFamily(f"ertis_{name}", text, labels=labels)
            for values, value in rows.items():
                family.add_metric(values, value)
            return family

        status = self._latest()
        node = InfoMetricFamily("ertis_node", "Central node")
        node.add_metric((), {"version": status.version, "host": status.host, "address": status.address})
        yield node
        yield gauge(
            "state", "State of the central node", {(state,): status.state == state for state in _STATES}, "state"
        )
        yield gauge("uptime_seconds", "Time since the start", {(): status.uptime_s})
        yield gauge("memory_bytes", "Resident memory of the receiving process", {(): status.memory_bytes})
        yield gauge("peers", "Sensor nodes connected", {(): status.peers})
        yield counter("refused", "Refused connections and messages", _by(status.refused), "reason")
        sensors = status.sensors.items()
        for field, text in _OF_SENSOR.items():
            yield counter(field, text, {(name,): getattr(each, field) for name, each in sensors}, "sensor")
        for field, text in _NOW_OF_SENSOR.items():
            yield gauge(field, text, {(name,): getattr(each, field) for name, each in sensors}, "sensor")
        for field, text in (("dropped", "Measurements discarded"), ("missing", "Sequence numbers never received")):
            rows = {(name, why): n for name, each in sensors for why, n in getattr(each, field).items()}
            yield counter(field, text, rows, "sensor", "reason")
        latency = {(name, q): s for name, each in sensors for q, s in _quantiles(each.image_latency)}
        yield gauge("image_latency_seconds", "Time from arrival to image, of the latest", latency, "sensor", "quantile")
        yield from self._rest(status, counter, gauge)

    @staticmethod
    def _rest(status: Status, counter: "Callable[..., Metric]", gauge: "Callable[..., Metric]") -> "Iterator[Metric]":
        """Yield the metrics of storage and of processing, if present."""
        archive, processing = status.archive, status.processing
        if archive is not None:
            for field in ("journal_bytes", "free_bytes", "room_bytes", "sealing"):
                yield gauge(f"archive_{field}", f"Archive: {field}", {(): getattr(archive, field)})
            yield counter("archive_poses", "Poses received", {(): archive.poses})
            for field in ("sealed", "sealing_failed", "set_aside"):
                yield counter(f"archive_{field}", f"Recordings: {field}", {(): getattr(archive, field)})
            for field in ("commit", "ack"):
                rows = {(q,): s for q, s in _quantiles(getattr(archive, field))}
                yield gauge(f"{field}_seconds", f"Time to {field}, of the latest", rows, "quantile")
        if processing is not None:
            yield gauge("workers", "Worker processes", {(): len(processing.workers)})
            for field in ("respawned", "retried", "quarantined", "publisher_respawned"):
                yield counter(field, f"Processing: {field}", {(): getattr(processing, field)})
            rows = {(q,): s for q, s in _quantiles(processing.process_time)}
            yield gauge(
                "process_seconds", "Processing time of a measurement in a worker, of the latest", rows, "quantile"
            )
            yield gauge("subscribers", "Applications connected", {(): len(processing.subscribers)})
            yield counter("groups", "Groups of simultaneous measurements", _by(processing.groups), "kind")


def _of_own_hosts(app: "WSGIApplication", host: str) -> "WSGIApplication":
    """Return an application that refuses other host names, as DNS rebinding sends them.

    A browser that fetches from ``evil.example`` names it as Host, even if that name resolves to this machine.
    """

    def guarded(environ: "WSGIEnvironment", start_response: "StartResponse") -> "Iterable[bytes]":
        if addresses.is_own_host(environ.get("HTTP_HOST", ""), host):
            return app(environ, start_response)
        text = b"This host name is not served here. Use localhost or a loopback address.\n"
        start_response("421 Misdirected Request", [("Content-Type", "text/plain"), ("Content-Length", str(len(text)))])
        return [text]

    return guarded


def _by(counts: dict[str, int]) -> dict[tuple[str, ...], float]:
    return {(name,): count for name, count in counts.items()}


def _quantiles(times: Percentiles) -> list[tuple[str, float]]:
    """Return quantiles in seconds."""
    return [(name, getattr(times, field) / 1e3) for name, field in _QUANTILES]
