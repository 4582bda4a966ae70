"""``ertis reference``: layouts, presets, keys of settings, and the completion script."""

import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import _image_options, _tables, options

if TYPE_CHECKING:
    from ertis_cli._toml_reference import TableReference
    from ertis_numba.settings import PresetKind

__all__ = ["reference"]

_WIDTH = 100


@click.command()
@click.argument("shell", type=click.Choice(["bash", "fish", "zsh"]))
@click.pass_context
def completion(ctx: click.Context, *, shell: str) -> None:
    """Print a script that completes commands and options in a shell.

    For bash, add eval "$(ertis reference completion bash)" to ~/.bashrc. For zsh, add eval "$(ertis reference
    completion zsh)" to ~/.zshrc, after 'autoload -U compinit; compinit'. For fish, save the output as
    ~/.config/fish/completions/ertis.fish.
    """
    from click.shell_completion import BashComplete, FishComplete, ZshComplete

    how = {"bash": BashComplete, "fish": FishComplete, "zsh": ZshComplete}[shell]
    click.echo(how(ctx.find_root().command, {}, "ertis", "_ERTIS_COMPLETE").source())


@click.command()
@click.argument("name", required=False, shell_complete=options.complete_layouts)
@options.as_json
def layouts(*, name: str | None, as_json: bool) -> None:
    """List the shipped layouts, or print one as TOML.

    NAME is a shipped layout, or a file of microphone positions, such as .csv in metres or .xml of Acoular. Its
    positions are printed in millimetres, relative to the centroid of the array.

    To make your own layout, save the output to a file and edit it. Then pass the file with --layout, or as array.layout
    in settings and scenes.
    """
    from ertis_numba.geometry import layout_file, layout_names, layout_text, load_layout
    from ertis_numba.settings import Array

    if name is not None:
        if name in layout_names() or not Path(name).suffix:
            text = layout_text(name)
        else:
            layout = load_layout(name)
            options.note_layout(Array(layout=name))
            text = layout_file(layout, name=layout.name, source=Path(name).name).to_toml()
        if as_json:
            options.print_json({"name": name, "toml": text})
        else:
            click.echo(text, nl=False)
        return
    rows = [
        {"name": each, "microphones": int(made.enabled.sum()), "word_bits": made.word_bits}
        for each, made in ((each, load_layout(each)) for each in layout_names())
    ]
    if as_json:
        options.print_json({"layouts": rows})
        return
    columns: dict[str, _tables.Side] = {"name": "left", "microphones": "right", "bits of a word": "right"}
    _tables.TextTable(columns, [tuple(map(str, row.values())) for row in rows]).print()


@click.command()
@click.argument("name", required=False, shell_complete=_image_options.preset_completion())
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


@click.command()
@click.argument(
    "document", type=click.Choice(["settings", "scene", "layout", "mounting"]), default="settings", metavar="[KIND]"
)
@options.as_json
def settings(*, document: str, as_json: bool) -> None:
    """Print every key of a settings, scene, layout or mounting file.

    KIND is settings (the default), scene, layout or mounting. The output is a template: save it, and remove the # from
    the keys to set. The template states the meaning, type, unit and default of each key, with an example.
    """
    from ertis_cli._toml_reference import reference as tables

    sections = tables(document)
    if as_json:
        options.print_json({"document": document, "tables": [asdict(section) for section in sections]})
        return
    click.echo("\n".join(line for section in sections for line in _lines(section)))


def _lines(section: "TableReference") -> Iterator[str]:
    """Yield the lines of a table; all but its header are comments."""
    yield from textwrap.wrap(section.about, _WIDTH, initial_indent="# ", subsequent_indent="# ")
    if section.header:
        yield f"# {section.header}"
    for key in section.keys:
        yield "#"
        unit = f", {key.unit}" if key.unit else ""
        about = f"{key.about} ({key.shape}{unit}; default: {key.default})"
        yield from textwrap.wrap(about, _WIDTH, initial_indent="#   ", subsequent_indent="#   ")
        yield f"# {key.example}"
    yield ""


@click.group()
def reference() -> None:
    """Print layouts, presets, the keys of settings, or a completion script."""


for each in (completion, layouts, presets, settings):
    reference.add_command(each)
