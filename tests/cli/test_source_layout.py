"""The page on the source layout, compared with the rules of imports."""

import ast
import re
import tomllib
from pathlib import Path

from tests.pages import ROOT

PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text("utf-8")
ROWS = re.findall(r"^\| (\d+) \| (\**)`(\w+)/`", PAGE, re.MULTILINE)
CORE = ("analysis", "base", "chain", "frames", "geometry", "kernels", "pipeline", "settings")


def floors():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each["name"] == "Layers of the package")
    return {room: number for number, floor in enumerate(reversed(layers), 1) for room in floor.split(" | ")}


def test_rooms_are_on_their_floors():
    assert {room: int(floor) for floor, _, room in ROWS} == floors()
    assert [int(floor) for floor, _, _ in ROWS] == sorted(int(floor) for floor, _, _ in ROWS)


def test_the_core_imports_nothing_of_other_rooms():
    assert sorted(room for _, mark, room in ROWS if mark) == list(CORE)
    used = set()
    for room in CORE:
        for path in Path(ROOT / "ertis_numba" / room).rglob("*.py"):
            modules = [
                node.module for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.ImportFrom)
            ]
            used |= {name.split(".")[1] for name in modules if name.startswith("ertis_numba.")}
    assert used <= set(CORE)


def test_files_of_the_reading_order_exist():
    text = (ROOT / "docs" / "explanation" / "core.md").read_text("utf-8")
    folders = (ROOT, *(ROOT / "ertis_numba").iterdir(), ROOT / "ertis_numba", ROOT / "ertis_numba" / "kernels")
    for name in re.findall(r"`([\w/]+\.py)`", text):
        assert any((folder / name).is_file() for folder in folders), name


def function_lengths(path):
    """Yield the place and the number of lines of each function body, without its docstring."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            body = node.body[ast.get_docstring(node) is not None :]
            n_lines = body[-1].end_lineno - body[0].lineno + 1 if body else 0
            yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", n_lines


def test_no_function_body_exceeds_sixty_lines():
    paths = [path for folder in ("ertis_numba", "cli", "bench") for path in (ROOT / folder).rglob("*.py")]
    lengths = dict(found for path in paths for found in function_lengths(path))
    assert len(lengths) > 5000
    assert {place: n_lines for place, n_lines in lengths.items() if n_lines > 60} == {}
