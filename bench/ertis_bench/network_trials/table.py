"""Markdown report of `performance`."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from ertis_bench.machine import sentence
from ertis_bench.markdown import table

__all__ = ["as_list", "network"]

_COMMON: Final = "CURVE encryption over loopback; sensor nodes, central node and application share the cores."
_CONDITIONS: Final = (
    "Sensor-node processes send measurements of 655 kB without sensors: words of noise, from all sensors at the same "
    "time. Every stored word was read again and compared. One value in 61 of every image was compared with a separate "
    "computation. Times start when the whole measurement is at the sensor node. They end when its ack arrives there, "
    "or when its image is in the application. They exclude sensors, USB, other hosts, and the first seconds, in which "
    "pipelines are created."
)
_FUSED: Final = (
    "The fused row uses words that were simulated for ten reflectors around the platform. The application starts while "
    "the central node serves, and computes tables when the first pulse arrives; pulses that arrive meanwhile wait. One "
    "fused pulse in ten was compared bit by bit with `Fuser` on the same images, and these images with a separate "
    "computation. Times start when the whole measurements are at the sensor node, so they exclude emission, recording "
    "and USB."
)
_MAPS: Final = (
    "The view of acoustic maps runs without a browser, and draws all frames that a browser would show. It makes its "
    "cameras in three seconds before the measurement. Maps have third octaves from 8.9 to 89.5 kHz. A frame shows the "
    "latest map of each sensor. One drawn map in ten was compared with a separate "
    "computation."
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
            " ".join([_COMMON, *_conditions(report["rows"])]),
        ]
    )


def _conditions(rows: Sequence[dict[str, Any]]) -> list[str]:
    parts = {row["part"] for row in rows}
    own = {"fused image": _FUSED, "acoustic maps": _MAPS}
    return [*([_CONDITIONS] if parts - own.keys() else []), *(text for part, text in own.items() if part in parts)]


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
    elif row["part"] == "fused image":
        what, goal, found = _fused(row), row["goal"], _fused_result(row)
    elif row["part"] == "acoustic maps":
        what, goal, found = _maps(row), row["goal"], _maps_result(row)
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


def _fused(row: dict[str, Any]) -> str:
    return (
        f"fused image of {row['sensors']} sensors × {row['rate_hz']:g} Hz, {row['directions']} directions each, for "
        f"{row['duration_s']:g} s"
    )


def _fused_result(row: dict[str, Any]) -> str:
    return (
        f"{row['pulses']:,} pulses sent, {row['fused']:,} fused, {row['skipped']} skipped, {row['incomplete']} "
        f"incomplete; {as_list(row['dropped'])} measurements and {row['images_dropped']} images dropped; "
        f"{row['checked']} pulses checked, {row['wrong']} wrong; last byte to fused image p50 {row['p50_ms']:.1f} ms, "
        f"p99 {row['p99_ms']:.1f} ms, slowest {row['slowest_ms']:.0f} ms; to its points p50 "
        f"{row['points_p50_ms']:.1f} ms, p99 {row['points_p99_ms']:.1f} ms. In the first {row['start_s']:g} s, which "
        f"these times exclude, the slowest image took {row['start_slowest_ms']:.0f} ms"
    )


def _maps(row: dict[str, Any]) -> str:
    return (
        f"live view of acoustic maps of {row['sensors']} passive sensors × {row['rate_hz']:g} Hz, {row['directions']} "
        f"directions each, for {row['duration_s']:g} s"
    )


def _maps_result(row: dict[str, Any]) -> str:
    return (
        f"{row['sent']:,} measurements sent, {row['published']:,} published, {as_list(row['dropped'])} dropped by the "
        f"central node; {row['maps']:,} maps made, {row['maps_dropped']} measurements dropped for the view "
        f"(and {row['start_dropped']} in its first seconds), "
        f"{row['replaced']} maps replaced by later ones before a frame; {row['frames']:,} frames drawn; "
        f"{row['checked']} maps checked, {row['wrong']} wrong"
    )
