"""Status of a central node as diagnostic_msgs/msg/DiagnosticArray."""

from typing import Any, Final

from ertis_numba.base.units import counted
from ertis_numba.network.status import SensorStatus, Status

__all__ = ["diagnostics_message"]

_OK, _WARN, _ERROR, _STALE = 0, 1, 2, 3  # Constants of DiagnosticStatus.
_NS: Final = 1_000_000_000


def diagnostics_message(status: Status) -> dict[str, Any]:
    """Return diagnostics of a central node (fault: error) and its sensors (absent: stale, missing: warning)."""
    sec, nanosec = divmod(status.time_ns, _NS)
    node = f"ertis {status.address}"
    values = {
        "state": status.state,
        "version": status.version,
        "uptime_s": f"{status.uptime_s:.0f}",
        "memory_bytes": status.memory_bytes,
        "refused": sum(status.refused.values()),
    }
    rows = [_row(_ERROR if status.fault else _OK, node, status.fault or status.state, status.host, values)]
    rows += [_sensor_row(f"{node}: {name}", name, sensor) for name, sensor in sorted(status.sensors.items())]
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}, "status": rows}


def _sensor_row(title: str, name: str, sensor: SensorStatus) -> dict[str, Any]:
    n_missing, n_dropped = sum(sensor.missing.values()), sum(sensor.dropped.values())
    level, message = _OK, f"{sensor.rate_hz:.1f} Hz"
    if not sensor.connected:
        level, message = _STALE, "not connected"
    elif n_missing:
        level, message = _WARN, f"{counted(n_missing, 'measurement')} missing"
    values = {
        "rate_hz": f"{sensor.rate_hz:.2f}",
        "received": sensor.received,
        "stored": sensor.stored,
        "published": sensor.published,
        "dropped": n_dropped,
        "missing": n_missing,
        "image_latency_p50_ms": f"{sensor.image_latency.p50_ms:.1f}",
    }
    return _row(level, title, message, name, values)


def _row(level: int, name: str, message: str, hardware_id: str, values: dict[str, object]) -> dict[str, Any]:
    return {
        "level": level,
        "name": name,
        "message": message,
        "hardware_id": hardware_id,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }
