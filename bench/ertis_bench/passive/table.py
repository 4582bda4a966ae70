"""Report about acoustic maps, and its tables."""

import importlib.metadata
import importlib.util
from collections.abc import Callable, Sequence
from typing import Any, Final

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.passive import agreement, bearings as passive_bearings, false_alarms, separation, times
from ertis_bench.passive._acoular import PACKAGE

__all__ = ["PARTS", "form", "run"]


PARTS: Final = ("false-alarms",)
"""Parts that can be measured alone."""


def run(
    *,
    count: int,
    seeds: int,
    bearings: int,
    trials: int,
    seed: int,
    only: Sequence[str] = (),
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Compare acoustic maps with those of Acoular, time both, and measure their errors."""
    described: dict[str, Any] = {
        "machine": machine.describe(),
        "seed": seed,
        "false_alarms": false_alarms.measure(trials=trials, seed=seed, say=say) if trials else None,
    }
    if only:
        return described
    installed = importlib.util.find_spec(PACKAGE) is not None
    return {
        **described,
        "count": count,
        "acoular": importlib.metadata.version(PACKAGE) if installed else None,
        "differences": agreement.compare(seed=seed, say=say) if installed else [],
        "times": times.measure(count=count, seed=seed, with_acoular=installed, say=say),
        "parts": times.times_of_parts(count=10 * count, seed=seed),
        "seeds": seeds,
        "separation": separation.measure(count=seeds, seed=seed, say=say) if seeds else [],
        "bearings": passive_bearings.measure(bearings, seed, say) if bearings else None,
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    if "differences" not in report:
        return f"{_false_alarms(report)}\n\nMeasured on {sentence(report['machine'])}"
    parts = [_differences(report), _times(report), _parts(report)]
    if report["separation"]:
        parts.append(_separation(report))
    if report["bearings"]:
        parts.append(_bearings(report["bearings"]))
    if report["false_alarms"]:
        parts.append(_false_alarms(report))
    return "\n\n".join([*parts, f"Measured on {sentence(report['machine'])}"])


def _differences(report: dict[str, Any]) -> str:
    if report["acoular"] is None:
        return "Acoular is not installed (`pip install 'ertis-numba[peers]'`)."
    rows = [
        [
            row["name"],
            f"{row['limit_db']:g}",
            f"{row['largest_db']:.4f}",
            f"{row['median_db']:.4f}",
            f"{row['levels']:,}",
        ]
        for row in report["differences"]
    ]
    head = ["method", "limit, dB", "largest difference, dB", "median, dB", "levels"]
    return (
        f"{table(head, rows)}\n\nDifferences of levels from those of Acoular {report['acoular']}, for the signals of "
        "three incoherent sources at 2 m with RMS values of 0.1, 0.05 and 0.03, and noise of each microphone with 0.01 "
        f"(seed {report['seed']}). Levels are those of 400 directions in each bin, down to {agreement.WITHIN_DB:g} dB "
        "below the maximum of the bin. CLEAN-SC is compared in each twelfth bin."
    )


def _times(report: dict[str, Any]) -> str:
    rows = []
    for row in report["times"]:
        ours, other = row["ours"], row.get("acoular")
        cells = [f"{ours['wall_ms']:.1f}", f"{ours['processor_ms']:.1f}"]
        if other:
            cells += [f"{other['wall_ms']:.0f}", f"{other['processor_ms']:.0f}"]
            cells += [f"{other[key] / ours[key]:.0f}×" for key in ("wall_ms", "processor_ms")]
        elif report["acoular"]:
            cells += ["–"] * 4  # Acoular has no such method.
        rows.append([row["name"], *cells])
    head = ["method", "time, ms", "processor time, ms"]
    if report["acoular"]:
        head += ["Acoular, ms", "Acoular's processor time, ms", "ratio", "ratio of processor times"]
    first = report["times"][0]
    return (
        f"{table(head, rows)}\n\nTime of a map of {times.DIRECTIONS} directions × {first['bands']} third octaves, from "
        f"36.4 ms of float32 signals of 32 microphones, with {first['bins']} bins and 63 blocks. Each is the least of "
        f"{report['count']} maps by Acoular, and of nine times as many by this package in between, after one round "
        "that is not counted. Processor times are sums over all cores, which other programs disturb less. Tables of "
        "directions are computed beforehand. The time of Acoular's CLEAN-SC is extrapolated from four bins."
    )


def _parts(report: dict[str, Any]) -> str:
    rows = [
        [name, f"{taken['wall_ms']:.2f}", f"{taken['processor_ms']:.2f}"] for name, taken in report["parts"].items()
    ]
    return table(["part of delay-and-sum", "time, ms", "processor time, ms"], rows)


def _separation(report: dict[str, Any]) -> str:
    pairs = list(dict.fromkeys((row["apart_deg"], row["weaker_db"]) for row in report["separation"]))
    found = {(row["name"], row["apart_deg"], row["weaker_db"]): row["shares"] for row in report["separation"]}
    rows = [
        [name, *(" / ".join(f"{share:.0%}" for share in found[name, *pair]) for pair in pairs)]
        for name in dict.fromkeys(row["name"] for row in report["separation"])
    ]
    heads = [f"{apart_deg:g}°" + f" and {weaker_db:g} dB" * bool(weaker_db) for apart_deg, weaker_db in pairs]
    head = ["sources separated", *(f"{each} apart" for each in heads)]
    low_hz, high_hz = separation.BAND_HZ
    averages = " / ".join(str(n) for n in separation.AVERAGES)
    return (
        f"{table(head, rows)}\n\nShare of {report['seeds']} seeds in which a map separates two incoherent sources, "
        f"with {averages} averaged measurements of 36.4 ms. The level of the stronger source, or of both, is "
        f"{separation.SNR_DB:g} dB above the noise of a microphone. The map has one band, {low_hz / 1e3:g}–"
        f"{high_hz / 1e3:g} kHz, and directions every half degree of azimuth. Two sources are separated if the two "
        "largest local maxima lie within 1.5° of them, one on each side of the middle between them, so that there is a "
        "dip. Settings are the defaults, with 2 sources for MUSIC and without the diagonal for CLEAN-SC."
    )


def _bearings(found: dict[str, Any]) -> str:
    rows = [
        [
            f"{row['snr_db']:g}",
            f"{row['error_deg']:.3f}",
            f"{row['bound_deg']:.3f}",
            f"{row['ratio']:.2f}",
            f"{row['missed']} of {row['trials']}",
        ]
        for row in found["errors"]
    ]
    head = ["SNR, dB", "RMS error, degrees", "Cramér–Rao bound, degrees", "error / bound", "missed"]
    leak, (low_hz, high_hz) = found["leak"], found["band_hz"]
    return (
        f"{table(head, rows)}\n\nErrors of the bearing of one source of plane waves, in the band "
        f"{low_hz / 1e3:g}–{high_hz / 1e3:g} kHz of one measurement. The SNR is that of a microphone in this band.\n\n"
        f"A leak 10 dB below the ambient noise in the band, after ten averaged measurements: found within 2° in "
        f"{leak['found']} of {leak['trials']} trials, at a requested rate of {leak['asked_rate']:g} false alarms per "
        "map."
    )


def _false_alarms(report: dict[str, Any]) -> str:
    found = report["false_alarms"]
    trials, (low_hz, high_hz) = found["trials"], found["band_hz"]
    rows = []
    for case in found["cases"]:
        cells = [case["name"], str(case["averages"])]
        for rate in sorted(case["rates"], key=lambda each: float(each["asked"])):
            low, high = rate["interval"]
            cells.append(f"{rate['alarms'] / trials:.4f} ({low:.4f}–{high:.4f})")
        rows.append(cells)
    asked = sorted(rate["asked"] for rate in found["cases"][0]["rates"])
    head = ["noise of", "averages", *(f"{each:g} requested" for each in asked)]
    return (
        f"{table(head, rows)}\n\nShare of maps that yield a bearing, of {trials:,} maps of noise without sources, with "
        f"its {false_alarms.CONFIDENCE:.0%} confidence interval (Clopper–Pearson), at each requested rate (seed "
        f"{report['seed']}). Maps have 3000 directions and the band {low_hz / 1e3:g}–{high_hz / 1e3:g} kHz. "
        "Measurements are float32 signals of 32 microphones, 36.4 ms long. The noise of the surroundings is diffuse "
        "and 30 dB above that of the microphones."
    )
