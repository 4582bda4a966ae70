"""``ertis reference presets``: shipped presets."""

from typing import TYPE_CHECKING

import click

from ertis_cli import _presets, _tables, options

if TYPE_CHECKING:
    from ertis_numba.settings import PresetKind

__all__ = ["presets"]


@click.command()
@click.argument("name", required=False, shell_complete=_presets.completion())
@options.as_json
def presets(*, name: str | None, as_json: bool) -> None:
    """List the shipped presets, or print one as TOML.

    Recording presets define the record length and the call. Pass their names with --preset to 'ertis capture' and
    'ertis import signals'. Processing presets define directions and ranges. Pass their names with --preset to 'ertis
    process' and 'ertis serve'. To make your own preset, save the output to a file, edit it, and pass it with
    --settings.
    """
    from ertis_numba.settings import preset_text

    if name is not None:
        text = preset_text(name)
        if as_json:
            options.print_json({"name": name, "toml": text})
        else:
            click.echo(text, nl=False)
        return
    rows = [*map(_recording, _names("recording")), *map(_processing, _names("processing"))]
    if as_json:
        options.print_json({"presets": rows})
        return
    columns: dict[str, _tables.Side] = {"name": "left", "kind": "left", "content": "left"}
    _tables.TextTable(columns, [(row["name"], row["kind"], row["content"]) for row in rows]).print()


def _names(kind: "PresetKind") -> tuple[str, ...]:
    from ertis_numba.settings import presets as names

    return names(kind)


def _recording(name: str) -> dict[str, str]:
    from ertis_numba.settings import Settings

    made = Settings.from_preset(name)
    call = f"{made.call.start_frequency_hz / 1e3:g} to {made.call.stop_frequency_hz / 1e3:g} kHz"
    return {"name": name, "kind": "recording", "content": f"{made.recording.duration_s * 1e3:.3g} ms, call from {call}"}


def _processing(name: str) -> dict[str, str]:
    from ertis_numba.settings import Processing

    made = Processing.from_preset(name)
    first_m, last_m = made.range_m
    return {"name": name, "kind": "processing", "content": f"directions {made.directions}, {first_m:g} to {last_m:g} m"}
