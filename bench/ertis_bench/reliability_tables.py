"""The report of `reliability` as Markdown."""

from typing import Any

from ertis_bench.machine import sentence
from ertis_bench.markdown import table

__all__ = ["reliability"]

_ONE = (
    "one sensor at {rate_hz:g} Hz for {seconds:g} s, {megabytes_per_s:.1f} MB/s",
    "0 lost; less than 25 % of a core",
    "{stored:,} stored, {lost} lost, {wrong} wrong; {cpu_percent:.1f} % of a core",
)
_CHAIN = (
    "{sensors} sensors in a SYNC chain at {rate_hz:g} Hz",
    "all groups complete, 0 mixed",
    "{complete:,} of {groups:,} groups complete, {mixed} mixed, {lost} lost, {wrong} wrong",
)
_WIRE = (
    (
        "{sent:,} blocks, {spoilt:,} with faults: bytes lost, added, changed, swapped; blocks cut, doubled, dropped; "
        "stalls and pulled plugs; read in pieces of 1 to 4,095 bytes"
    ),
    "0 false accepts; 0 untouched lost",
    "{false_accepts} displaced, mixed, wrongly numbered or repeated blocks accepted; {untouched_lost} untouched lost",
)
_ALTERED = (
    "of these, whole ones in which words were exchanged for others",
    "nothing in a block tells but its bits",
    "{altered:,} accepted; {altered_splices:,} with `--refuse-splices`",
)
_UNPLUGS = (
    "{unplugged} times unplugged while it measured",
    "back within 3 s; 0 wrong",
    "{noticed} times back; {slowest_s:.2f} s from plug to measurement at most; {wrong} wrong",
)
_KILLS = (
    "{kills:,} captures ended by kill -9",
    "0 lost of what was reported; all readable",
    "{reported:,} reported, {lost} lost, {wrong} wrong, {unreadable} unreadable, {left over} files left over",
)
_JOURNALS = (
    "{kills:,} writers of journals ended by kill -9",
    "0 lost of what was reported",
    "{told:,} reported, {lost} lost, {wrong} wrong, {unexpected} unexpected",
)
_SEALS = (
    "{kills:,} sealings ended by kill -9, and done again",
    "0 broken files",
    "{broken} broken, {different} other than without a kill, {left_over} files left over",
)
_FULL = (
    "disk full",
    "an error; nothing reported that is not stored",
    "exit code {exit code}: “{said}”; {reported} reported, {lost} lost, {wrong} wrong",
)


def reliability(report: dict[str, Any]) -> str:
    """Return what was tried and what became of it, with the seed that tries it again."""
    wire = report["wire"]
    counted = wire | {
        "false_accepts": wire["mixed"] + wire["wrong_counter"] + wire["twice"],
        "altered_splices": report["wire_splices"]["altered"],
    }
    rows = [
        _row(_ONE, report["sustained"]),
        _row(_CHAIN, report["chain"]),
        _row(_WIRE, counted),
        _row(_ALTERED, counted),
        _row(_UNPLUGS, report["unplugs"]),
        _row(_KILLS, report["kills"]),
        _row(_JOURNALS, report["journals"]),
        _row(_SEALS, report["seals"]),
        _row(_FULL, report["disk_full"]) if report["disk_full"] else (*_FULL[:2], "not tried: only root can"),
    ]
    extent = " --long" if report["long"] else ""
    made = f"By `ertis bench reliability{extent} --seed {report['seed']}`. {sentence(report['machine'])}"
    return f"{table(('tried', 'wanted', 'found'), rows, numbers=False)}\n\n{made}"


def _row(texts: tuple[str, str, str], found: dict[str, Any]) -> tuple[str, str, str]:
    tried, wanted, became = texts
    return tried.format(**found), wanted, became.format(**found)
