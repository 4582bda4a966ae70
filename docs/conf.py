"""Sphinx configuration of the documentation site: `make docs`, with warnings as errors and no external resources."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "cli"), str(ROOT / "bench")]

project = "ertis-numba"
author = "The authors of ertis-numba"
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx_click", "sphinx_copybutton"]
exclude_patterns = ["pictures/*.py"]
smartquotes = False
html_theme = "furo"
html_title = "ertis-numba"
html_show_sphinx = False
html_show_copyright = False  # LICENSE has it
html_copy_source = False
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
copybutton_prompt_text = r"^(\w*)\$ "
copybutton_prompt_is_regexp = True
numpydoc_show_class_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings contain the types, with shapes and units
autodoc_default_options = {"members": True}
suppress_warnings = ["misc.highlighting_failure"]  # tables of formats contain fragments of code

MARKS = re.compile(r"(?<=\w)_(?!\w)|\*|(?<=\btcp):(?=//)")  # addresses of nodes must not become links
REFERENCE = re.compile(r"<!-- keys of (\w+) -->")
OUTSIDE = r"\[([^\]]+)\]\(%s((?!\.\.|docs/)[^)#\s]+)\)"


def setup(app: Any) -> None:
    """Register the hooks that change pages and help texts."""
    app.connect("source-read", _name_what_is_outside)
    app.connect("source-read", _write_reference)
    if "sphinx-click-process-envars" not in app.events.events:  # version 6 emits this event without registering it
        app.add_event("sphinx-click-process-envars")
    for part in ("options", "arguments", "envars", "envvars"):
        app.connect(f"sphinx-click-process-{part}", _write_plainly)
    for part in ("description", "options", "arguments"):
        app.connect(f"sphinx-click-process-{part}", _take_literally)


def _name_what_is_outside(_: Any, page: str, source: list[str]) -> None:
    """Replace links to folders and pages outside docs/ by their paths; other files can be downloaded."""
    outside = "../" * (page.count("/") + 1)

    def named(match: re.Match[str]) -> str:
        path = ROOT / match[2]
        return f"{match[1]} (`{match[2]}` in the source)" if path.is_dir() or path.suffix == ".md" else match[0]

    source[0] = re.sub(OUTSIDE % re.escape(outside), named, source[0])


def _write_reference(_: Any, page: str, source: list[str]) -> None:
    """Insert the keys of each kind of TOML file into the settings reference."""
    if page == "reference/settings":
        source[0] = REFERENCE.sub(lambda match: "\n".join(_tables(match[1])), source[0])


def _tables(document: str) -> Iterator[str]:
    from ertis_numba.toml_reference import reference  # noqa: PLC0415  the paths are set above

    for section in reference(document):
        yield from (f"### {section.header or 'Top level'}".replace("[", "\\["), "", section.about, "")
        yield from ("| key | meaning | type | unit | default | example |", "| --- | --- | --- | --- | --- | --- |")
        for key in section.keys:
            code = (f"`{text}`" if text else "" for text in (key.default, key.example))
            cells = (f"`{key.name}`", key.about, key.shape, key.unit, *code)
            yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
        yield ""


def _write_plainly(_: Any, __: Any, lines: list[str]) -> None:
    """Replace Python representations by typed values: paths, texts and lists of variables."""
    for place, line in enumerate(lines):
        plain = re.sub(r"PosixPath\('([^']*)'\)", r"\1", line)
        if plain.lstrip().startswith((".. envvar::", ".. _", "``")):
            plain = re.sub(r"\[('[^\]]*')\]", lambda match: match[1].replace("'", ""), plain)
            plain = re.sub(r"^(\s*)``'(.*)'``$", r"\1``\2``", plain)
        lines[place] = plain


def _take_literally(_: Any, __: Any, lines: list[str]) -> None:
    """Escape reStructuredText markup in help texts, which are written for a terminal."""
    lines[:] = [line if line.lstrip().startswith("..") else MARKS.sub(r"\\\g<0>", line) for line in lines]
