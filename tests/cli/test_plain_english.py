"""Texts and names follow docs/glossary.md: `make check` runs these tests."""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("ertis_numba", "cli", "bench", "examples")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

RELATIVE = re.compile(r"(What|Who|Whose|Which|Whether|How|From|That|Where|When|Why)\b")
HEADING = re.compile(r"(?m)^#+ +(.*)")

SUMMARIES_ALLOWED: dict[str, str] = {}
"""Docstrings that may begin with a relative word or contain "what", and why."""

HOW_TO = re.compile(r"How[ -]to ")
"""Headings of how-to guides, as Diátaxis names this kind of page."""

BANNED = {
    "bend": "curvature",
    "crew": "worker pool",
    "dither": "fractional-delay offsets",
    "ear": "receiver",
    "energy": "amplitude",
    "energies": "amplitudes",
    "epoch": "session_id",
    "film": "playback",
    "know": "register",
    "moment": "time step",
    "mouth": "transmitter",
    "rehearsal": "A/B render",
    "settled": "acked_through",
    "shelf": "journal store",
    "strangers": "handshake monitor",
    "tell": "report",
    "tells": "reports",
    "told": "reported",
    "waker": "wake-up socket",
    "whole_taps": "integer_taps",
}
"""Parts of identifiers that the glossary replaces, and their replacement."""

_MODULATOR = "the sigma-delta modulator adds dither"
IDENTIFIERS_ALLOWED = dict.fromkeys(["_DITHER_MEAN", "_dither", "dither", "_noise_and_dither", "dither_of"], _MODULATOR)
"""Identifiers with such a part, and why they keep it."""

CLASSES_ALLOWED = {"Lane": "the protocol of every device, and its implementation for CUDA"}
"""Class names that are used twice, and why."""


NAMED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef, ast.arg, ast.Assign, ast.AnnAssign)


@cache
def modules():
    """Return the nodes of each module that document or define a name."""
    return {
        path.relative_to(ROOT).as_posix(): [
            node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, NAMED)
        ]
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def documented():
    """Yield (path, name, docstring) of every module, class and function."""
    for path, nodes in modules().items():
        for node in nodes:
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    yield path, getattr(node, "name", "module"), text


def identifiers():
    """Yield (path, identifier) of every class, function, parameter, constant and attribute that is defined."""
    for path, nodes in modules().items():
        for node in nodes:
            match node:
                case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.arg(arg=name):
                    yield path, name
                case ast.Assign(targets=targets):
                    yield from ((path, name) for target in targets for name in names_of(target))
                case ast.AnnAssign(target=target):
                    yield from ((path, name) for name in names_of(target))


def names_of(target):
    if isinstance(target, ast.Name):
        return [target.id]
    if isinstance(target, ast.Attribute):
        return [target.attr]
    return [name for element in getattr(target, "elts", ()) for name in names_of(element)]


def parts(identifier):
    """Return the words of an identifier in lower case."""
    return [part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", identifier)]


def is_banned(identifier):
    joined = f"_{'_'.join(parts(identifier))}_"
    return any(f"_{word}_" in joined for word in BANNED)


def summary(text):
    return " ".join(text.split("\n\n", 1)[0].split())


def test_docstring_summaries_begin_with_a_noun_or_a_verb():
    bad = {
        f"{path}:{name}": summary(text)
        for path, name, text in documented()
        if RELATIVE.match(text) or re.search(r"\bwhat\b", summary(text), re.IGNORECASE)
    }
    assert {place: text for place, text in bad.items() if place not in SUMMARIES_ALLOWED} == {}
    assert set(SUMMARIES_ALLOWED) <= set(bad)
    assert len(SUMMARIES_ALLOWED) <= 30


def test_headings_begin_with_a_noun_or_a_verb():
    headings = [
        (page.relative_to(ROOT).as_posix(), heading.strip())
        for page in PAGES
        for heading in HEADING.findall(re.sub(r"(?ms)^```.*?^```", "", page.read_text("utf-8")))
    ]
    assert [pair for pair in headings if RELATIVE.match(pair[1]) and not HOW_TO.match(pair[1])] == []


def test_tables_write_ratios_as_relative_to():
    ratio = re.compile(r"\bby (that|those) of\b|\bless (that|those) of\b")
    bad = [
        (page.name, line)
        for page in PAGES
        for line in page.read_text("utf-8").splitlines()
        if line.startswith("|") and ratio.search(line)
    ]
    assert bad == []


def test_identifiers_use_the_words_of_the_glossary():
    bad = defaultdict(set)
    for path, name in identifiers():
        if is_banned(name):
            bad[name].add(path)
    assert {name: sorted(paths) for name, paths in bad.items() if name not in IDENTIFIERS_ALLOWED} == {}
    assert set(IDENTIFIERS_ALLOWED) <= set(bad)


def test_class_names_are_used_once():
    places = defaultdict(list)
    for path, nodes in modules().items():
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path)
    twice = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert {name: paths for name, paths in twice.items() if name not in CLASSES_ALLOWED} == {}
    assert set(CLASSES_ALLOWED) <= set(twice)


def test_few_sentences_exceed_30_words():
    sentences = [sentence for page in PAGES for sentence in sentences_of(page.read_text("utf-8"))]
    long = [sentence for sentence in sentences if len(sentence.split()) > 30]
    assert len(long) < 0.02 * len(sentences), long[:20]


def sentences_of(text):
    """Return the sentences of a page, without code, tables and headings."""
    text = re.sub(r"(?ms)^(```|~~~).*?^\1|<!--.*?-->", "", text)
    paragraphs = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text)
    kept = [each for each in paragraphs if not re.match(r"\s*(\||#|:::|!\[)", each)]
    joined = [" ".join(re.sub(r"\]\([^)]*\)", "]", each).split()) for each in kept]
    return [sentence for each in joined for sentence in re.split(r"(?<=[.!?:;])\s+", each) if sentence]


def test_docstrings_name_existing_parameters_and_attributes():
    bad = []
    for path, nodes in modules().items():
        for node in nodes:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                known = names_within(node)
                for section in ("Parameters", "Attributes"):
                    bad += [(path, node.name, name) for name in entries(text, section) if name not in known]
    assert bad == []


def entries(text, section):
    """Return the names that a numpydoc section describes."""
    found = re.search(rf"(?ms)^{section}\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)", text)
    lines = found[1].splitlines() if found else []
    heads = [line.split(" : ")[0] for line in lines if line and not line.startswith(" ")]
    return [name.strip(" *") for head in heads for name in head.split(",")]


def names_within(node):
    """Return parameters of a function; fields, attributes, methods and parameters of methods of a class."""
    if isinstance(node, ast.FunctionDef):
        return {arg.arg for arg in ast.walk(node.args) if isinstance(arg, ast.arg)}
    found = {each.name for each in node.body if isinstance(each, ast.FunctionDef)}
    found |= {each.target.id for each in node.body if isinstance(each, ast.AnnAssign)}
    for each in ast.walk(node):
        if isinstance(each, ast.FunctionDef) and each.name in ("__init__", "__call__"):
            found |= names_within(each)
        if isinstance(each, ast.Attribute) and isinstance(each.value, ast.Name) and each.value.id == "self":
            found.add(each.attr)
    for base in node.bases:
        name = getattr(base, "value", base)  # The class itself, if it is generic.
        found |= names_within(classes()[name.id]) if getattr(name, "id", None) in classes() else set()
    return found


@cache
def classes():
    return {node.name: node for nodes in modules().values() for node in nodes if isinstance(node, ast.ClassDef)}
