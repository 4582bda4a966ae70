"""``ertis bench peers`` checks the images of other libraries, and compares their times with those of this package.

Acoular, PyTorch and JAX run in processes of their own, because their imports change threads and warn.
"""

import functools
import importlib.util
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench import timing
from ertis_bench.peers import comparison, table
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError

OURS = comparison.OURS
SCRIPT = """
import json, sys
from ertis_bench import timing
from ertis_bench.peers import comparison

timing._WARM_UP, timing._WARM_UP_S = 1, 0.0
comparison.DIRECTIONS = (90,)
chosen = (sys.argv[1], comparison.OURS)
comparison.PEERS = {name: peer for name, peer in comparison.PEERS.items() if name in chosen}
print(json.dumps(comparison.run(count=1, say=lambda text: None)))
"""


@pytest.fixture
def quick(monkeypatch):
    """Compare NumPy, a package that does not exist, and this package in 90 directions, hardly warmed up."""
    monkeypatch.setattr(timing, "_WARM_UP", 1)
    monkeypatch.setattr(timing, "_WARM_UP_S", 0.0)
    monkeypatch.setattr(comparison, "DIRECTIONS", (90,))
    peers = {name: comparison.PEERS[name] for name in (comparison.PAPER, "NumPy", OURS)}
    peers["Absent"] = comparison.Peer("no_such_package", lambda _: pytest.fail("it is not installed"))
    monkeypatch.setattr(comparison, "PEERS", peers)


@pytest.mark.usefixtures("quick")
def test_peers_are_checked_and_timed(tmp_path):
    page = tmp_path / "a.md"
    page.write_text("<!-- ertis bench peers -->\nold\n<!-- /ertis bench peers -->\n", "utf-8")
    done = CliRunner().invoke(cli, ["bench", "peers", "--count", "1", "--json", "--update", str(page)])
    assert done.exit_code == 0, (done.output, done.exception)
    report = json.loads(done.stdout)
    rows = {row["name"]: row for row in report["rows"]}
    assert list(rows) == [comparison.PAPER, "NumPy", OURS]
    assert all(row["median_ms"] > 0 and row["first_s"] > 0 for row in rows.values())
    assert rows["NumPy"]["error_db"] < -35
    assert rows[OURS]["error_db"] < -35
    assert rows[comparison.PAPER]["points_per_s"] is None
    assert min(rows[name]["points_per_s"] for name in ("NumPy", OURS)) > 1e5
    text = page.read_text("utf-8")
    assert "| Absent | not installed (`pip install 'ertis-numba[peers]'`) |" in text
    assert re.search(r"\| NumPy \(2\S+\) \| \d+\.\d\d \(\d+\.\d×\) \|", text)
    assert "| Absent |" not in text.partition("| threads |")[2]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("wrong", [lambda image: np.roll(image, 1, axis=1), lambda image: image * 1.1])
def test_wrong_image_of_a_peer_is_refused(monkeypatch, wrong):
    def spoiled(settings, make):
        right = make(settings)
        return comparison.Implementation(lambda words: wrong(right.process(words)), None, 1)

    peer = comparison.Peer("numpy", functools.partial(spoiled, make=comparison.PEERS["NumPy"].make))
    monkeypatch.setattr(comparison, "PEERS", {"Spoiled": peer})
    with pytest.raises(DataError, match=r"image of Spoiled in 90 directions has an error of .* dB .* limit is -30 dB"):
        comparison.run(count=1, say=lambda _: None)


@pytest.mark.usefixtures("quick")
def test_wrong_sums_of_a_peer_are_refused(monkeypatch):
    """Delay-and-sum alone is checked as well."""

    def spoiled(settings, make):
        right = make(settings)
        return comparison.Implementation(right.process, lambda words: lambda: 2 * right.process(words), 1)

    peer = comparison.Peer("numpy", functools.partial(spoiled, make=comparison.PEERS["NumPy"].make))
    monkeypatch.setattr(comparison, "PEERS", {"Spoiled": peer})
    with pytest.raises(DataError, match="image of Spoiled in 90 directions has an error of"):
        comparison.run(count=1, say=lambda _: None)


@pytest.mark.parametrize("name", ["Acoular", "PyTorch", "JAX"])
def test_image_of_another_library_is_right(name):
    package = comparison.PEERS[name].package
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed; it belongs to the extra 'peers'")
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, name],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    theirs, _ = json.loads(done.stdout.splitlines()[-1])["rows"]
    assert theirs["name"] == name
    assert theirs["error_db"] < -35
    assert theirs["points_per_s"] > 0


def row(name, **changes):
    usual = {"threads": 2, "directions": 90, "error_db": -40.0, "median_ms": 2.0, "first_s": 0.5, "points_per_s": 10**8}
    return {"name": name, **usual, **changes}


def test_better_results_of_others_are_stated():
    other = row("Quick", median_ms=1.0, error_db=-41.0, first_s=0.6, points_per_s=2 * 10**8)
    rows = {(each["name"], 90): each for each in (other, row(OURS))}
    assert table.better(rows, [90]) == (
        "Better results than those of this package: time of 90 directions: Quick; error of 90 directions: Quick; "
        "delay-and-sum alone: Quick."
    )
    rows["Quick", 90] = row("Quick", points_per_s=None)
    assert table.better(rows, [90]) == "No other implementation has a better result in any column."
