"""The report of `reliability` as Markdown."""

from typing import Any

from ertis_bench.machine import sentence
from ertis_bench.markdown import table

__all__ = ["reliability"]


def reliability(report: dict[str, Any]) -> str:
    """Return what was tried and what became of it, with the seed that tries it again."""
    rows = [*_captures(report), *_faults(report), *_kills(report)]
    extent = "--long " if report["long"] else ""
    return "\n\n".join(
        [
            table(("tried", "wanted", "found"), rows),
            f"By `ertis bench reliability {extent}--seed {report['seed']}`. {sentence(report['machine'])}",
        ]
    )


def _captures(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    one, chain, plugs = report["sustained"], report["chain"], report["unplugs"]
    return [
        (
            f"one sensor at {one['rate_hz']:g} Hz for {one['seconds']:g} s, {one['megabytes_per_s']:.1f} MB/s",
            "0 lost; below 25 % of a core",
            f"{one['stored']:,} stored, {one['lost']} lost, {one['wrong']} wrong; {one['cpu_percent']:.1f} %",
        ),
        (
            f"{chain['sensors']} sensors in a SYNC chain at {chain['rate_hz']:g} Hz",
            "all groups complete, 0 mixed",
            (
                f"{chain['complete']:,} of {chain['groups']:,} groups complete, {chain['mixed']} mixed, "
                f"{chain['lost']} lost, {chain['wrong']} wrong"
            ),
        ),
        (
            f"unplugged {plugs['unplugged']} times while it measures",
            "back within 3 s; 0 wrong",
            (
                f"{plugs['noticed']} times back, the first measurement {plugs['slowest_s']:.2f} s after the plug at most; "
                f"{plugs['wrong']} wrong"
            ),
        ),
    ]


def _faults(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    wire = report["wire"]
    return [
        (
            (
                f"{wire['sent']:,} blocks, faults on {wire['spoilt']:,}: bytes lost, added, changed, swapped; blocks cut, "
                "doubled, dropped; stalls, unplugging; read in pieces of 1 to 4,095 bytes"
            ),
            "0 false accepts; 0 untouched lost",
            (
                f"{wire['mixed'] + wire['wrong_counter'] + wire['twice']} accepted that were displaced, mixed, under a "
                f"wrong number or twice; {wire['untouched_lost']} untouched lost"
            ),
        ),
        (
            f"of these, {wire['altered']:,} in which only words were changed, at their place",
            "nothing on the wire tells",
            f"{wire['altered'] - wire['altered_accepted']:,} refused, {wire['altered_accepted']:,} accepted",
        ),
    ]


def _kills(report: dict[str, Any]) -> list[tuple[str, str, str]]:
    kills, seals, full = report["kills"], report["seal_kills"], report["disk_full"]
    rows = [
        (
            f"{kills['kills']} captures ended by kill -9",
            "0 lost of what was reported; all readable",
            (
                f"{kills['reported']:,} reported, {kills['lost']} lost, {kills['wrong']} wrong, "
                f"{kills['unreadable']} unreadable, {kills['left over']} files left over"
            ),
        ),
        (
            f"{seals['kills']} sealings ended by kill -9",
            "0 broken files",
            f"{seals['broken']} broken, {seals['lost']} measurements lost",
        ),
    ]
    if full is None:
        return [*rows, ("disk full", "an error, nothing reported that is not stored", "not tried: only root can")]
    found = f"exit code {full['exit code']}, {full['reported']} reported, {full['lost']} lost, {full['wrong']} wrong"
    return [*rows, ("disk full", "an error, nothing reported that is not stored", f"{found}: “{full['said']}”")]
