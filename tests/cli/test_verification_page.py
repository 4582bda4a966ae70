"""The page on verification quotes the tables of other pages, and names commands that exist."""

import re

import pytest
from ertis_cli.main import cli

from tests.pages import DOCS, ROOT, path_of

PAGE = path_of("verification")
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.read_text("utf-8").splitlines()
    if re.search(r"\| `(ertis bench|make)", line)
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].replace(" ", "_"))
def test_results_are_those_of_the_linked_page(row):
    _, _, result, _, link = row
    if link == "–":
        return
    (target,) = re.findall(r"\]\((.*?)\)", link)
    text = (PAGE.parent / target).resolve().read_text("utf-8").replace("−", "-").replace(" %", "%")
    numbers = re.findall(r"-?\d[\d,.]*%?", result.replace("−", "-").replace(" %", "%"))
    whole = [rf"(?<![\d,.-]){re.escape(number.rstrip(',.'))}(?!\d|[,.]\d)" for number in numbers]
    assert any(all(re.search(each, paragraph) for each in whole) for paragraph in text.split("\n\n"))


def test_commands_exist():
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    benches = cli.get_command(cli.make_context("ertis", ["bench"]), "bench").commands
    for word in re.findall(r"`make ([\w-]+)", PAGE.read_text("utf-8")):
        assert word in targets
    for word in re.findall(r"`ertis bench ([\w-]+)", PAGE.read_text("utf-8")):
        assert word in benches


def test_page_is_short_and_linked_from_the_first_pages():
    assert len(PAGE.read_text("utf-8").splitlines()) <= 120
    assert "docs/explanation/verification.md" in (ROOT / "README.md").read_text("utf-8")
    assert "explanation/verification.md" in (DOCS / "index.md").read_text("utf-8")
