"""Help of commands with many options, under headings."""

from collections.abc import Mapping
from typing import Final

import click

from ertis_cli._config import long_name

__all__ = ["SectionedCommand"]

_OTHER: Final = "Other options"
_SECTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "Input and output": ("output", "sensor", "without", "mounting", "emitter-diameter", "dtype", "strict", "force"),
    "Directions and ranges (default: those of the recording)": (
        *("preset", "directions", "azimuth", "elevation", "range", "level"),
    ),
    "Settings (default: those of the recording)": (
        *("settings", "method", "beamformer", "weighting"),
        *("clean", "array-weights", "wavefront", "last-stage", "bands", "average", "focus"),
    ),
    "Accuracy": ("max-error", "plan", "explain", "verify"),
    "Computation": ("device", "threads", "workers"),
}
"""Long names of options by the heading above them."""
_TITLES: Final = {name: title for title, names in _SECTIONS.items() for name in names}


class SectionedCommand(click.Command):
    """Command whose help has headings above its options."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of each heading."""
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in (*_SECTIONS, _OTHER)}
        for option in self.get_params(ctx):
            if isinstance(option, click.Option) and (record := option.get_help_record(ctx)) is not None:
                sections[_TITLES.get(long_name(option), _OTHER)].append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)
