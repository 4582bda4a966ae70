"""Commands and code of docs/how-to/many.md; test_many_cluster.py runs those for clusters."""

import json
import re
import shutil
import warnings
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.campaign import Campaign
from tests.campaigns import InlinePool
from tests.pages import page

ROOT = Path(__file__).parents[2]
PAGE = page("many")
BLOCKS = re.findall(r"```\n\$ (ertis .*?)\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    place = tmp_path_factory.mktemp("many")
    (place / "runs").mkdir()
    for name in ("front", "left"):
        shutil.copy(ROOT / "data" / "synthetic" / "reflectors.h5", place / "runs" / f"{name}.h5")
    return place


@pytest.fixture(autouse=True)
def _there(place, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setattr(Campaign, "_pool", lambda _: InlinePool())  # starts faster than processes


def run(command, code=0):
    done = CliRunner().invoke(cli, command.removeprefix("ertis ").replace("'", "").split())
    assert done.exit_code == code, (command, done.stderr, done.exception)
    return done


def shape(text):
    """Return a text without its numbers, column widths and order of lines."""
    return sorted(re.sub(r"[\d.]+|─+| +", " ", line).strip() for line in text.splitlines() if line.strip())


def test_commands_of_the_page_run_in_order(place):
    first, again, as_json = BLOCKS[:3]
    assert shape(run(first[0]).stderr) == shape(first[1])
    assert shape(run(again[0]).stderr) == shape(again[1])
    (place / "runs" / "left.h5").unlink()
    (place / "runs" / "torn.h5").write_bytes((place / "runs" / "front.h5").read_bytes()[:90_000])
    shutil.rmtree(place / "images")
    reported = [json.loads(line) for line in run(as_json[0], code=1).stdout.splitlines()]
    wanted = [json.loads(line.replace(", …}", "}").replace(" …", "")) for line in as_json[1].splitlines()]
    for mine, theirs in zip(
        sorted(reported[:-1], key=lambda one: one["recording"]),
        sorted(wanted[:-1], key=lambda one: one["recording"]),
        strict=True,
    ):
        assert mine.items() >= {key: value for key, value in theirs.items() if key != "error"}.items()
        assert mine.get("error", "").startswith(theirs.get("error", ""))
    assert reported[-1] | {"seconds": 0} == wanted[-1] | {"seconds": 0}
    assert list(reported[-1]) == list(wanted[-1])


def test_code_of_the_page_runs(place, capsys):
    code, _ = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (place / "runs" / "torn.h5").unlink(missing_ok=True)
    with warnings.catch_warnings(action="error"):
        exec(compile(code, "many.md", "exec"), {"__name__": "__main__"})
    assert "runs/front.h5 made" in capsys.readouterr().out


def test_code_for_object_storage_reads_a_recording(place):
    """tests/storage/test_file_objects.py reads it by byte ranges from a server."""
    _, code = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    with ertis.open_recording(place / "runs" / "front.h5") as recording:
        sensor = recording.sensor
    code = code.replace("https://server/platform.h5", "runs/front.h5").replace('"front"', repr(sensor))
    found = {}
    exec(compile(code.replace("[12]", "[0]"), "many.md", "exec"), found)
    assert found["image"].amplitude.any()


def test_page_has_its_table():
    table = PAGE.partition("<!-- ertis bench many -->")[2].partition("<!-- /ertis bench many -->")[0]
    assert "| 1 worker of 1 thread |" in table
    assert "LocalCluster" in table
