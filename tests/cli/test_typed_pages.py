"""Blocks of the README and of the guide can be typed in an empty folder, from the first one to the last one of a page.

These tests follow names of files and of Python from block to block. Other tests run the blocks.
"""

import ast
import builtins
import itertools
import re
import shlex
from fnmatch import fnmatch
from pathlib import Path

import pytest
from ertis_cli import _examples

from tests.pages import GUIDE, ROOT

PAGES = [ROOT / "README.md", *(path for path in GUIDE if path.parent.name in {"how-to", "tutorial"})]
SUFFIXES = "h5|toml|wav|bin|csv|tum|json|png|pdf|svg|html|ply|pcd|pgm|mcap|npz|mat|py|launch.py|yaml"
FILE = re.compile(rf"[\w./*-]+\.({SUFFIXES})")
OWN = re.compile(r"[A-Z\d_]+(\.\w+)?/?")  # Capitals stand for files of the reader.
WRITES = re.compile(r"-o|--output|--save\S*|--link|--log|--metrics")
READS = re.compile(r"open_\w+|load\w*|read_\w+|Playback|add_poses|find_recordings")
RESULTS = {
    "simulate": (".h5",),
    "map": (".map.h5", ".yaml"),
    "plot": (".png",),
    "process": (".energy.h5",),
    "acoustic": (".acoustic.h5",),
    "fuse": (".fused.h5",),
}


def blocks(text):
    """Yield the language and the text of each block, with the name of the file that the text before it states."""
    yield from re.findall(r"(?:`([\w.]+)`:\n\n)?^```(\w*)[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def commands(language, block):
    lines = re.sub(r"\\\n>?\s*", " ", block).splitlines()
    if language == "sh":
        return [line for line in lines if line.strip() and not line.startswith("#")]
    return [match[1] for line in lines if language in {"console", ""} and (match := re.match(r"\w*\$ +(.*)", line))]


def inputs_and_outputs(command):
    """Return the files that a command needs, and those that it writes."""
    words = shlex.split(command, comments=True)
    name = words[1] if words[:1] == ["ertis"] else words[0] if words else ""
    if name == "example":
        return [], [file for each in words[2:] if each != "&" for file in _examples.named(each)]
    if name in {"mkdir", "cp"}:
        return words[1:-1], [words[-1]]
    if words[:2] == ["ros2", "launch"] and not FILE.fullmatch(words[2]):
        words = words[4:]  # a file of a ROS package
    written = [after for before, after in itertools.pairwise(words) if WRITES.fullmatch(before)]
    needed = [word.removeprefix("./") for word in words[1:] if FILE.fullmatch(word) and word not in written]
    if words[1:3] == ["keys", "new"]:
        written = [f"{words[3]}.public.toml", f"{words[3]}.secret.toml"]
    for each in (written or needed) if name in RESULTS else ():
        written = [*written, *(each.removesuffix(Path(each).suffix) + end for end in RESULTS[name])]
    return needed, written


def files_in(tree):
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [text for text in texts if FILE.fullmatch(text)]


def read_in(tree):
    """Return the files that a program reads."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    reading = [call for call in calls if READS.fullmatch(getattr(call.func, "attr", getattr(call.func, "id", "")))]
    return [file for call in reading for file in files_in(call)]


def exists(file, made):
    if OWN.fullmatch(file) or "/dev/" in file:
        return True
    return any(fnmatch(each, file) or file.startswith(f"{each}/") for each in made)


def missing_files(text):
    made, missing = set(), []
    for name, language, block in blocks(text):
        made |= {name} if name and language not in {"console", "sh", "python", "py", ""} else set()
        for command in commands(language, block):
            needed, written = inputs_and_outputs(command)
            missing += [(command, file) for file in needed if not exists(file, made)]
            made |= {*written}
        if language in {"python", "py"}:
            tree = ast.parse(block)
            missing += [(block, file) for file in read_in(tree) if not exists(file, made)]
            made |= {*files_in(tree)}
    return missing


def unknown_names(text):
    known, unknown = {*dir(builtins), "__name__"}, set()
    for _, language, block in blocks(text):
        if language in {"python", "py"}:
            nodes = list(ast.walk(ast.parse(block)))
            known |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
            known |= {node.arg for node in nodes if isinstance(node, ast.arg)}
            known |= {(node.asname or node.name).split(".")[0] for node in nodes if isinstance(node, ast.alias)}
            known |= {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
            unknown |= {node.id for node in nodes if isinstance(node, ast.Name)} - known
    return unknown


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_blocks_name_files_that_earlier_blocks_of_their_page_write(path):
    assert missing_files(path.read_text("utf-8")) == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_code_names_what_the_page_has_imported_or_computed(path):
    assert unknown_names(path.read_text("utf-8")) == set()


def test_readme_says_what_names_in_capitals_are():
    assert "names in capitals stand for your own files" in " ".join(PAGES[0].read_text("utf-8").split())


@pytest.mark.parametrize(
    ("text", "files", "names"),
    [
        ("```console\n$ ertis process a.h5\n```", ["a.h5"], set()),
        ("```console\n$ ertis process OWN.h5\n$ ertis peaks OWN.energy.h5 own.h5\n```", ["own.h5"], set()),
        ("```console\n$ ertis simulate s.toml\n```", ["s.toml"], set()),
        ("`s.toml`:\n\n```toml\nseed = 1\n```\n```console\n$ ertis simulate s.toml\n$ ertis plot s.h5\n```", [], set()),
        ('```python\nimport ertis_numba as e\ne.open_recording("b.h5"), x\n```', ["b.h5"], {"x"}),
    ],
)
def test_missing_files_and_names_are_found(text, files, names):
    assert [file for _, file in missing_files(text)] == files
    assert unknown_names(text) == names
