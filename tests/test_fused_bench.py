"""``ertis bench network --only fusion``, with a short measurement, fills its table."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.network import fused_receiver, live_fusion
from ertis_bench.network.fused_receiver import FusedReceiverJob
from ertis_cli.main import cli

from ertis_numba.fusion import Fuser
from ertis_numba.network.fused_subscriber import FusedArrival
from tests.publishing import image

MARKER = "ertis bench network --only fusion"
AHEAD = (0.0, 0.0, 0.0, 1.0)
MOUNTINGS = {"front": ((0.2, 0.0, 0.0), AHEAD), "back": ((-0.2, 0.0, 0.0), AHEAD)}


def test_fused_bench_counts_and_checks_all_pulses(tmp_path, monkeypatch):
    monkeypatch.setattr(live_fusion, "START_S", 0.5)
    target = tmp_path / "page.md"
    target.write_text(f"<!-- {MARKER} -->\nold\n<!-- /{MARKER} -->\n", "utf-8")
    options = ["--duration", "2", "--json", "--quiet", "--folder", str(tmp_path), "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "network", "--only", "fusion", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["rows"]
    assert row["pulses"] == 20
    assert row["fused"] + row["skipped"] <= row["pulses"]
    assert 0 < row["checked"] <= row["fused"]
    assert row["wrong"] == 0
    assert row["published"] + sum(row["dropped"].values()) == 80
    text = target.read_text("utf-8")
    assert f"20 pulses sent, {row['fused']} fused, {row['skipped']} skipped" in text
    assert "words of noise" not in text


@pytest.mark.parametrize(("gain", "share", "wrong"), [(1.0, 1.0, 0), (1.0, 0.99, 1), (0.5, 1.0, 1)])
def test_fused_bench_finds_wrong_images(tmp_path, gain, share, wrong):
    images = {name: image(sensor=name, reflectors=[(20.0, 1.5, 0.1)]) for name in MOUNTINGS}
    fused = Fuser(MOUNTINGS, **fused_receiver.SPACINGS)(images.values())
    fused.image.amplitude[:] *= share
    expected = tmp_path / "expected.npz"
    np.savez(expected, **{name: gain * each.amplitude[None] for name, each in images.items()})
    job = FusedReceiverJob(address="", diary="", keys=("", ""), expected=str(expected), mountings=MOUNTINGS)
    found = fused_receiver.checked(job, [FusedArrival(fused, images, 0, 0, 0)])
    assert found == {"checked": 1, "wrong": wrong}
