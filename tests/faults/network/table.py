"""Markdown table of the network's faults."""

from collections.abc import Mapping
from typing import Any, Final

from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.network_trials.table import as_list

from tests.faults.trials import command

__all__ = ["ROWS", "network", "row"]

_STORED: Final = "{stored:,} stored, {lost} lost, {twice} twice, {wrong} wrong, {silent} unexplained"
_NEEDS_ROOT: Final = "not tried: requires root"

ROWS: Final[dict[str, tuple[str, str, str]]] = {
    "centrals": (
        "kill -9 of the central node, mid-stream",
        "0 acked lost, 0 twice",
        "{kills:,} kills, {before a line:,} of them before a random line of code: {acked:,} acked, "
        + _STORED
        + ", {left_over} files left over; {missing:,} reported missing because the sensor node's memory was full",
    ),
    "nodes": (
        "kill -9 of sensor nodes, mid-stream",
        "0 acked lost, 0 twice; with a spool, 0 kept lost",
        "{kills:,} kills, {before a line:,} of them before a random line of code: {promised:,} promised, " + _STORED,
    ),
    "captures": (
        "kill -9 of `ertis capture --to --spool` and of the central node",
        "0 kept lost, 0 twice",
        "{kills:,} kills: {kept:,} kept, {stored:,} stored, {lost} lost, {twice} twice, {wrong} wrong",
    ),
    "sealings": (
        "kill -9 while sealing, {with central:,} times together with the central node",
        "0 broken files",
        "{kills:,} kills: {broken} broken, " + _STORED,
    ),
    "workers": (
        "kill -9 of a worker",
        "0 lost except by policy, storage unaffected",
        (
            "{kills:,} kills: {received:,} = {published:,} published + {dropped all} dropped; images: {untold} "
            "unexplained, {wrong} wrong, {twice} twice; {lost} lost, acked within {slowest ack, ms:.0f} ms"
        ),
    ),
    "disk_full": (
        "full disk (20 MB), freed later",
        "no acks, state FAULT, then resumed; 0 lost",
        "{acked in fault} acked during the fault, state {state}, “{said}”; then " + _STORED,
    ),
    "disk_fails": (
        "failing disk, repaired later",
        "no acks, state FAULT, then resumed; 0 lost",
        "{acked in fault} acked during the fault, state {state}; then " + _STORED,
    ),
    "away": (
        "central node killed for {away_s:g} s",
        "0 lost, 0 twice, bounded memory",
        _STORED + "; back after {back after, s:.1f} s, {memory grew, MB:.0f} MB in the ring; with 2.5 times its "
        "capacity: {missing too long:,} reported missing, {lost too long} lost, {memory grew too long, MB:.0f} MB",
    ),
    "stopped": (
        "central node suspended for {away_s:g} s",
        "0 lost, 0 twice, bounded memory",
        _STORED + "; back after {back after, s:.1f} s, {memory grew, MB:.0f} MB in the ring; with 2.5 times its "
        "capacity: {missing too long:,} reported missing, {lost too long} lost, {memory grew too long, MB:.0f} MB",
    ),
    "meddled": (
        "acks lost, repeated and reordered; {drops} connections dropped, cable unplugged {cuts} times",
        "0 lost, 0 twice",
        "{faults:,} faults: " + _STORED,
    ),
    "hosts": (
        "two hosts; 1 % of packets lost, 1 % twice, 2 % late; cable unplugged {cuts} times",
        "0 lost, 0 twice",
        _STORED + "; {packets:,} packets, back after at most {slowest back, s:.1f} s",
    ),
    "hostile": (
        "{connections:,} hostile connections: garbage, huge frames, slow handshakes",
        "real sensors lose nothing; memory growth < 50 MB",
        _STORED + "; slowest ack {slowest ack, ms:.0f} ms; memory growth {memory grew, MB:.0f} MB",
    ),
    "keys": (
        "no key, unknown key, wrong server key, wrong role, another's serial, key removed while connected",
        "refused and counted; a removed key within 1 s",
        "{tried} tried, let in: {let in all}; refused: {refused all}; last ack {removed, s:.2f} s after the removal; "
        + _STORED,
    ),
    "fuzzed": (
        "{inputs:,} malformed messages",
        "refused, no crash",
        "{answers:,} answers, {restarts} restarts, memory growth {memory grew, MB:.0f} MB; real sensor: " + _STORED,
    ),
    "hellos": (
        "{hellos:,} hostile hellos: sizes, names, lines, depth, numbers",
        "refused within 1 s, memory growth < 200 MB; acks of others < 200 ms",
        "accepted: {taken all}; slowest refusal {slowest refusal, s:.2f} s, memory growth {memory grew, MB:.0f} MB; "
        "slowest ack {slowest ack, ms:.0f} ms, and {slowest ack alone, ms:.0f} ms before the trial; real sensor: "
        + _STORED,
    ),
    "files": (
        "{files:,} hostile files read by `ertis verify`, `info` and `process`",
        "refused within 1 s, memory growth < 200 MB",
        (
            "{reads:,} reads; accepted: {taken all}; crashes: {crashes all}; tracebacks: {failed all}; slowest "
            "{slowest, s:.2f} s ({slowest, s of CPU:.2f} s of processor time), memory growth {memory grew, MB:.0f} MB"
        ),
    ),
    "flips": (
        "{flips:,} bits flipped in encrypted messages, on both ports",
        "0 aborts, 0 acked lost; connections are closed",
        "{restarts} restarts, sockets left over: {sockets left}; {acked:,} acked, " + _STORED,
    ),
    "gone": (
        "kill -9 of {kills:,} sensor nodes while the central node is behind with reading",
        "0 aborts, 0 acked lost",
        "{restarts} restarts, sockets left over: {sockets left}; {acked:,} acked, " + _STORED,
    ),
    "overload": (
        "overload 2×, with a capacity of {capacity per s:.0f} images/s",
        "received = published + dropped; latency bounded",
        (
            "{received:,} = {published:,} + {dropped all}; p50 {p50, ms:.0f} ms, p99 {p99, ms:.0f} ms, slowest "
            "{slowest, ms:.0f} ms"
        ),
    ),
    "subscribers": (
        "one slow and one stopped application",
        "p99 of other applications grows by < 10 %",
        (
            "p99 {p99 alone, ms:.1f} ms without them, {p99 beside, ms:.1f} ms with them ({grew, %:+.1f} %); "
            "{untold} unexplained"
        ),
    ),
    "groups": (
        "lost and double SYNC, clock step of an hour",
        "that group flagged, others aligned by SYNC count",
        (
            "{complete:,} of {pulses:,} groups complete, {mixed} mixed; flagged for a pulse: {pulse flags}; "
            "for the clock: {clock flags after} of {complete after} after its step, {clock flags before} before"
        ),
    ),
    "power_cuts": (
        "power cuts of central nodes and of sensor nodes with a spool, with and without failing syncs",
        "0 acked lost, 0 twice",
        "{states:,} states of the disk: {acknowledged:,} acked or kept, {lost} lost, {twice} twice, {wrong} wrong",
    ),
}


def network(report: dict[str, Any]) -> str:
    """Return the trials and their results, with the seed that repeats them."""
    rows = [row(name, report[name]) for name in ROWS if name in report]
    cells = table(("fault", "required", "result"), rows, numbers=False)
    return f"{cells}\n\nCommand: `{command('network', report)}`. {sentence(report['machine'])}"


def row(name: str, found: Mapping[str, Any] | None) -> tuple[str, str, str]:
    """Return the trials, limits and results of one part.

    ``found`` is None if the part could not be tried.
    """
    tried, wanted, became = ROWS[name]
    if found is None:
        return tried.partition(",")[0].partition("{")[0].rstrip(), wanted, _NEEDS_ROOT
    if "reason" in found:
        return tried, wanted, f"not tried: {found['reason']}"
    values = dict(found)
    values["faults"] = sum(found.get("meddled", {}).values())
    for field in ("dropped", "refused", "let in", "taken", "crashes", "failed"):
        values[f"{field} all"] = as_list(found.get(field))
    return tried.format(**values), wanted, became.format(**values)
