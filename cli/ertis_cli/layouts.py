"""``ertis reference layouts``: shipped array layouts, and layout files as TOML in millimetres."""

from pathlib import Path

import click

from ertis_cli import _tables, options

__all__ = ["layouts"]


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
