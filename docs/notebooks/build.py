"""Run the notebooks in empty folders and store their outputs of text, by `make notebooks`.

Pictures and HTML are not stored: the documentation site has them, and notebooks with them are large.
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

__all__ = ["NOTEBOOKS", "executed", "texts_of"]

NOTEBOOKS = sorted(Path(__file__).parent.glob("*.ipynb"))
_TIMEOUT_S = 600
_SHOWN = {"image/png", "text/html"}


def executed(path: Path, folder: str | Path) -> nbformat.NotebookNode:
    """Return a notebook with the outputs of running it in a folder."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=_TIMEOUT_S, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    commands = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    client.execute(env=os.environ | {"PATH": commands})
    return notebook


def texts_of(notebook: nbformat.NotebookNode) -> list[str]:
    """Return the text that each cell prints or shows; objects with a picture have none."""
    return ["".join(map(_text, cell.get("outputs", ()))) for cell in notebook.cells]


def _text(output: nbformat.NotebookNode) -> str:
    if output.output_type == "stream":
        return str(output.text)
    data = output.get("data", {})
    return "" if _SHOWN & data.keys() else str(data.get("text/plain", ""))


def main() -> None:
    """Run all notebooks and store their texts."""
    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(path, folder)
        for cell in notebook.cells:
            for name in ("execution", "collapsed"):
                cell.metadata.pop(name, None)
            if cell.cell_type == "code":
                cell.outputs = [each for each in cell.outputs if _text(each)]
                cell.execution_count = None
                for each in cell.outputs:
                    if "execution_count" in each:
                        each.execution_count = None
        notebook.metadata.language_info = {"name": "python"}
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
