"""Markdown report of `reliability`."""

from typing import Any

from ertis_bench.machine import sentence
from ertis_bench.markdown import table

from tests.faults.trials import command

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
        "{sent:,} blocks, {spoilt:,} with faults: bytes lost, added, changed, swapped; blocks truncated, duplicated, "
        "dropped; stalls and unplugged cables; read in chunks of 1 to 4,095 bytes"
    ),
    "0 false accepts; 0 untouched lost",
    "{false_accepts} displaced, mixed, wrongly numbered or repeated blocks accepted; {untouched_lost} untouched lost",
)
_ALTERED = (
    "of these, complete blocks with changed words, or with as many words lost as added",
    "only the bits can reveal the fault",
    "{altered:,} accepted",
)
_SPLICES = (
    "the same blocks with `--refuse-splices`",
    "fewer; 0 untouched lost",
    "{altered:,} accepted; {untouched_lost} untouched lost",
)
_UNPLUGS = (
    "sensor unplugged {unplugged} times during measurements",
    "reconnected within 3 s; 0 wrong",
    "reconnected {noticed} times; at most {slowest_s:.2f} s from connection to measurement; {wrong} wrong",
)
_KILLS = (
    "{kills:,} captures ended by kill -9",
    "0 reported measurements lost; all readable",
    "{reported:,} reported, {lost} lost, {wrong} wrong, {unreadable} unreadable, {left over} files left over",
)
_JOURNALS = (
    "{kills:,} writers of journals ended by kill -9",
    "0 reported measurements lost",
    "{told:,} reported, {lost} lost, {wrong} wrong, {unexpected} unexpected",
)
_SEALS = (
    "{kills:,} sealings ended by kill -9, then repeated",
    "0 broken files",
    "{broken} broken, {different} different from an undisturbed sealing, {left_over} files left over",
)
_FLIPS = (
    "{tried:,} damaged files: a flipped bit, a zeroed block or a truncation ({each})",
    "0 silent losses or changes; 0 tracebacks",
    "{noticed:,} reported, {harmless:,} without effect, {silent} silent, {crashed} tracebacks",
)
_FULL = (
    "disk full",
    "an error; all reported measurements stored",
    "exit code {exit code}: “{said}”; {reported} reported, {lost} lost, {wrong} wrong",
)
_SIGNALS = (
    "{signals:,} signals at random times of {commands} commands",
    "each ends within 1 s with its documented exit code",
    "{late} late, at most {slowest_s:.2f} s (`ertis {slowest}`); {codes} other codes; {tracebacks} tracebacks",
)
_POWER_CUTS = (
    "power cuts of captures, with and without failing syncs",
    "0 reported measurements lost, 0 twice",
    "{states:,} states of the disk: {acknowledged:,} reported, {lost} lost, {twice} twice, {wrong} wrong",
)


_ROWS = (
    ("sustained", _ONE),
    ("chain", _CHAIN),
    ("wire", _WIRE),
    ("wire", _ALTERED),
    ("splices", _SPLICES),
    ("unplugs", _UNPLUGS),
    ("kills", _KILLS),
    ("journals", _JOURNALS),
    ("seals", _SEALS),
    ("flips", _FLIPS),
    ("disk_full", _FULL),
    ("signals", _SIGNALS),
    ("power_cuts", _POWER_CUTS),
)


def reliability(report: dict[str, Any]) -> str:
    """Return the trials and their results, with the seed that repeats them."""
    rows = [_row(texts, report[name]) for name, texts in _ROWS if name in report]
    cells = table(("trial", "required", "result"), rows, numbers=False)
    return f"{cells}\n\nCommand: `{command('reliability', report)}`. {sentence(report['machine'])}"


def _row(texts: tuple[str, str, str], found: dict[str, Any] | None) -> tuple[str, str, str]:
    tried, wanted, became = texts
    if found is None:
        return tried, wanted, "not tried: mounting a small disk requires root"
    if "reason" in found:
        return tried, wanted, f"not tried: {found['reason']}"
    if "wrong_counter" in found:
        found = found | {"false_accepts": found["mixed"] + found["wrong_counter"] + found["twice"]}
    return tried.format(**found), wanted, became.format(**found)
