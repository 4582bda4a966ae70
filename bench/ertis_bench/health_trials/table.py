"""Markdown report of the health checks' trials."""

from typing import Any

from ertis_bench.markdown import table

__all__ = ["health"]


def health(report: dict[str, Any]) -> str:
    """Return the counts of false alarms and of named faults."""
    rows = [
        [
            row["fault"],
            f"{row['named']} of {row['trials']}",
            "yes" if row["observable"] else "no",
            row["why"],
        ]
        for row in report["rows"]
    ]
    scenes = ", ".join(f"{count} of {name}" for name, count in report["scenes"].items())
    observable = [row for row in report["rows"] if row["observable"]]
    counted = sum(row["named"] for row in observable), sum(row["trials"] for row in observable)
    command = f"ertis bench health{' --long' if report['long'] else ''} --seed {report['seed']}"
    return "\n\n".join(
        [
            f"Faults named in healthy arrays: {len(report['alarms'])} of {report['healthy']} ({scenes}).",
            f"Observable faults named on their channels: {counted[0]} of {counted[1]}.",
            table(["fault", "named", "observable", "condition or reason"], rows),
            f"Command: `{command}`.",
        ]
    )
