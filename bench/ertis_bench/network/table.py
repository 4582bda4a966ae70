"""Markdown report of `figures`."""

from collections.abc import Mapping
from typing import Any, Final

from ertis_bench.machine import sentence
from ertis_bench.markdown import table

__all__ = ["as_list", "network"]

_CONDITIONS: Final = (
    "CURVE encryption over loopback; sensor nodes, central node and application share the cores. Sensor-node "
    "processes send measurements of 655 kB without sensors: words of noise, from all sensors at the same time. "
    "Every stored word was read again and compared. One value in 61 of every image was compared with a separate "
    "computation. Times start when the whole measurement is at the sensor node. They end when its ack arrives "
    "there, or when its image is in the application. They exclude sensors, USB, other hosts, and the first seconds,"
    " in which pipelines are created."
)


def as_list(found: Any) -> str:
    """Return counts by reason, or names, as a list in words."""
    if isinstance(found, Mapping):
        return ", ".join(f"{count:,} {reason}" for reason, count in sorted(found.items())) or "0"
    return ", ".join(found or ()) or "none"


def network(report: dict[str, Any]) -> str:
    """Return the performance of a central node on this machine, beside its targets."""
    rows = [(row["what"], row["goal"], row["found"]) for row in map(_figure, report["rows"])]
    return "\n\n".join(
        [
            table(("", "goal", "measured"), rows, numbers=False),
            f"Measured on {sentence(report['machine'])}",
            _CONDITIONS,
        ]
    )


def _figure(row: dict[str, Any]) -> dict[str, str]:
    cpu = "; ".join(f"{name} {share:.0f} %" for name, share in row["cpu_percent"].items())
    if row["part"] == "storage":
        what = (
            f"storage, {row['sensors']} sensors × {row['rate_hz']:g} Hz ({row['megabytes_per_s']:.0f} MB/s) for "
            f"{row['duration_s']:g} s"
        )
        goal = "0 lost; ack p99 < 100 ms"
        found = (
            f"{row['stored']:,} of {row['offered']:,} stored, {row['lost']} lost, {row['missing']} reported missing, "
            f"{row['wrong']} wrong, {row['twice']} twice; ack p50 {row['p50_ms']:.1f} ms, p99 {row['p99_ms']:.1f} ms, "
            f"slowest {row['slowest_ms']:.0f} ms; {row['rate_reached_hz']:.1f} Hz reached"
        )
    else:
        what = (
            f"{row['part']}, {row['directions']} directions, {row['sensors']} × {row['rate_hz']:g} Hz for "
            f"{row['duration_s']:g} s"
        )
        goal = row["goal"]
        found = (
            f"{row['received']:,} = {row['published']:,} published + {as_list(row['dropped'])} dropped; "
            f"{row['images']:,} images received, {row['skipped']} skipped, {row['wrong']} wrong; capture to image p50 "
            f"{row['p50_ms']:.1f} ms, p99 {row['p99_ms']:.1f} ms, slowest {row['slowest_ms']:.0f} ms"
        )
    if "max_hz" in row:
        found += (
            f"; relative to the node's own workers in the same run: p50 {row['added_p50_ms']:+.1f} ms, p99 "
            f"{row['added_p99_ms']:+.1f} ms; {row['max_hz']:.0f} images/s of {row['offered_hz']:.0f} "
            f"offered, {row['max_here_hz']:.0f} with the node's own workers"
        )
        cpu += "; the cluster's scheduler and workers are not counted"
    return {"what": what, "goal": goal, "found": f"{found}. Processor time in % of one core: {cpu}"}
