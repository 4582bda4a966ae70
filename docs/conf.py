"""How Sphinx makes a site of these pages: `make docs`, with warnings as errors and nothing loaded from elsewhere."""

import re
import sys
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
autodoc_typehints = "none"  # the docstrings say them, with shapes and units
autodoc_default_options = {"members": True}
suppress_warnings = ["misc.highlighting_failure"]  # fragments of code in tables of formats

MARKS = re.compile(r"(?<=\w)_(?!\w)|\*|(?<=\btcp):(?=//)")  # an address of a node is no link
OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./((?!docs/)[^)#\s]+)\)")


def setup(app: Any) -> None:
    """Be told of each page before it is read."""
    app.connect("source-read", _name_what_is_outside)
    for part in ("description", "options", "arguments"):
        app.connect(f"sphinx-click-process-{part}", _take_literally)


def _name_what_is_outside(_: Any, page: str, source: list[str]) -> None:
    """Name folders and pages beside docs/, which are not part of the site; files can be downloaded."""
    if "/" in page:  # in a folder of docs/, ../ is docs/ itself
        return

    def named(match: re.Match[str]) -> str:
        path = ROOT / match[2]
        return f"{match[1]} (`{match[2]}` in the source)" if path.is_dir() or path.suffix == ".md" else match[0]

    source[0] = OUTSIDE.sub(named, source[0])


def _take_literally(_: Any, __: Any, lines: list[str]) -> None:
    """Keep marks of reStructuredText in help texts, which are written for a terminal, from being taken for such."""
    lines[:] = [line if line.lstrip().startswith("..") else MARKS.sub(r"\\\g<0>", line) for line in lines]
