"""The notebooks of the documentation run in an empty folder, and print the numbers that they contain."""

import re
import sys

import nbformat
import pytest

from tests.pages import DOCS

sys.path.insert(0, str(DOCS / "notebooks"))
from build import NOTEBOOKS, executed, texts_of

NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
MAX_BYTES = 20_000


def test_every_notebook_is_listed():
    listed = re.findall(r"^notebooks/(\w+)$", (DOCS / "index.md").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == [path.stem for path in NOTEBOOKS]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_contains_small_outputs_of_text_only(path):
    kept = nbformat.read(path, as_version=4)
    nbformat.validate(kept)
    outputs = [each for cell in kept.cells for each in cell.get("outputs", ())]
    assert all(each.output_type == "stream" or {*each.data} == {"text/plain"} for each in outputs)
    assert path.stat().st_size < MAX_BYTES


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_prints_what_it_contains(path, tmp_path):
    """Plans of other instruction sets change the last digits."""
    stored, ran = texts_of(nbformat.read(path, as_version=4)), executed(path, tmp_path)
    printed = texts_of(ran)
    for wanted, given in zip(stored, printed, strict=True):
        assert NUMBER.sub("0", given) == NUMBER.sub("0", wanted)
        numbers = list(map(float, NUMBER.findall(wanted)))
        assert list(map(float, NUMBER.findall(given))) == pytest.approx(numbers, rel=0.1, abs=0.1)
    shown = [data for cell in ran.cells for each in cell.get("outputs", ()) for data in each.get("data", {})]
    assert {*shown} & {"image/png", "text/html"}
    assert not any(each.get("name") == "stderr" for cell in ran.cells for each in cell.get("outputs", ()))
