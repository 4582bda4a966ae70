"""Reference of TOML keys: it lists and describes every key, and the examples are valid."""

import json
import re
import sys
import tomllib
from importlib import resources

import msgspec
import pytest
from click.testing import CliRunner
from ertis_cli._toml_reference import DOCUMENTS, reference
from ertis_cli.main import cli

from ertis_numba.geometry import load_layout
from ertis_numba.settings import Settings
from ertis_numba.settings.documents import TomlTable
from ertis_numba.simulation import load_scene
from tests.pages import ROOT, page, run

READERS = {"settings": Settings.load, "scene": load_scene, "layout": load_layout, "mounting": load_scene}


def structures(kind):
    """Yield the settings structures of a document."""
    yield kind
    for field in msgspec.structs.fields(kind):
        for part in (field.type, *getattr(field.type, "__args__", ())):
            if isinstance(part, type) and issubclass(part, TomlTable):
                yield from structures(part)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_key_is_fully_described(document):
    for section in reference(document):
        assert section.about
        for key in section.keys:
            assert key.about, (section.header, key.name)
            assert key.shape
            assert key.default
            assert tomllib.loads(key.example).keys() == {key.name}
            assert key.unit or not re.search(r"_(hz|m|mm|s|deg|db|dbfs|c|pa|ppm|percent|m_s)$", key.name)


def test_reference_lists_every_key():
    listed = {key.name for document in DOCUMENTS for section in reference(document) for key in section.keys}
    tables = {section.header.strip("[]").rpartition(".")[2] for name in DOCUMENTS for section in reference(name)}
    for kind in {each for document in DOCUMENTS.values() for each in structures(document)}:
        for name in kind.__struct_fields__:
            assert name in listed | tables | {"array", "call", "recording", "air", "processing", "accuracy"}, name


@pytest.mark.parametrize("document", DOCUMENTS)
def test_file_of_examples_is_accepted(document):
    READERS[document](resources.files("ertis_examples") / f"every_{document}_key.toml")


@pytest.mark.parametrize("document", DOCUMENTS)
def test_unchanged_template_gives_the_defaults(document):
    """Every line of the template is a comment until a user removes the comment mark."""
    text = CliRunner().invoke(cli, ["reference", "settings", document]).stdout
    assert tomllib.loads(text) == {}
    for section in reference(document):
        assert not section.header or f"# {section.header}\n" in text
        for key in section.keys:
            assert f"# {key.example}\n" in text


def test_template_with_a_changed_key_is_accepted(tmp_path):
    text = CliRunner().invoke(cli, ["reference", "settings"]).stdout
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("# [air]", "[air]").replace("# temperature_c", "temperature_c"))
    assert Settings.load(path).air.temperature_c == 24.5


def test_settings_reference_is_printed_as_json():
    reported = json.loads(CliRunner().invoke(cli, ["reference", "settings", "layout", "--json"]).stdout)
    (table,) = reported["tables"]
    (found,) = (key for key in table["keys"] if key["name"] == "positions_mm")
    assert (found["unit"], found["default"]) == ("mm", "none")


def test_reference_pages_show_the_present_code(tmp_path):
    """`make reference` updates them, in a process of its own: commands keep the help option of their first context."""
    assert run(tmp_path, sys.executable, ROOT / "docs" / "reference" / "build.py", "--check").stdout == ""


def test_settings_page_has_every_key():
    for document in DOCUMENTS:
        for section in reference(document):
            for key in section.keys:
                assert f"| `{key.name}` | {key.about}".replace("|", "") in page("settings").replace("\\|", "").replace(
                    "|", ""
                )


def test_scenes_page_has_every_key_of_scenes():
    keys = [key.name for section in reference("scene") for key in section.keys]
    assert [key for key in keys if not re.search(rf"[`.\[]{key}[`\]]", page("scenes"))] == []
