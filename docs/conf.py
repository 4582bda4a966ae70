"""Sphinx configuration of the documentation site: `make docs`, with warnings as errors and no external resources."""

import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "cli"), str(ROOT / "bench")]

os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))  # for the notebooks

project = "ertis-numba"
author = "The authors of ertis-numba"
extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx_copybutton"]
smartquotes = False
html_theme = "furo"
html_title = "ertis-numba"
html_show_sphinx = False
html_show_copyright = False  # LICENSE has it
html_copy_source = False
nb_execution_mode = "cache"  # A notebook runs again only if its code has changed.
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_output_stderr = "remove"
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
copybutton_prompt_text = r"^(\w*)\$ "
copybutton_prompt_is_regexp = True
numpydoc_show_class_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings contain the types, with shapes and units
autodoc_default_options = {"members": True}
suppress_warnings = ["misc.highlighting_failure"]  # tables of formats contain fragments of code

OUTSIDE = r"\[([^\]]+)\]\(%s((?!\.\.|docs/)[^)#\s]+)\)"


def setup(app: Any) -> None:
    """Register the hooks that change pages and help texts."""
    app.connect("source-read", _name_what_is_outside)


def _name_what_is_outside(_: Any, page: str, source: list[str]) -> None:
    """Replace links to folders and pages outside docs/ by their paths; other files can be downloaded."""
    outside = "../" * (page.count("/") + 1)

    def named(match: re.Match[str]) -> str:
        path = ROOT / match[2]
        return f"{match[1]} (`{match[2]}` in the source)" if path.is_dir() or path.suffix == ".md" else match[0]

    source[0] = re.sub(OUTSIDE % re.escape(outside), named, source[0])
