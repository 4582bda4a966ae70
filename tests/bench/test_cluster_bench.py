"""``ertis bench network --only cluster``, with a short measurement, fills its table."""

import json

import pytest
from click.testing import CliRunner
from ertis_bench.network import imaging
from ertis_bench.network_trials import performance
from ertis_cli.main import cli

from tests.dask_clusters import cluster_of_threads

processing = performance.processing


def only_on_the_cluster(folder, duration_s, seed, *, rate_hz, scheduler, **options):
    """Measure the cluster at the lower rate only. Other tests cover the remaining cases, which are slow."""
    if scheduler is not None and rate_hz == 10.0:
        return processing(folder, duration_s, seed, rate_hz=rate_hz, scheduler=scheduler, **options)
    published = round(duration_s * (rate_hz if scheduler is None else rate_hz / 2))
    return {"p50_ms": 1.0, "p99_ms": 2.0, "sent": round(duration_s * rate_hz), "published": published}


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(imaging, "_WARM_UP_S", 0.4)
    monkeypatch.setattr(performance, "processing", only_on_the_cluster)
    monkeypatch.setattr(performance.cluster, "local_cluster", cluster_of_threads)


def test_cluster_bench_measures_and_updates_the_page(tmp_path):
    target = tmp_path / "page.md"
    target.write_text(
        "<!-- ertis bench network --only cluster -->\nold\n<!-- /ertis bench network --only cluster -->\n", "utf-8"
    )
    options = ["--duration", "1", "--json", "--quiet", "--folder", str(tmp_path), "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "network", "--only", "cluster", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    (row,) = json.loads(done.stdout)["rows"]
    assert 0 < row["received"] == row["published"] + sum(row["dropped"].values())
    assert row["wrong"] == row["twice"] == row["unbalanced"] == row["uncounted"] == row["untold"] == 0
    assert "workers of the cluster at tcp://" in row["choice"]
    assert row["added_p50_ms"] == row["p50_ms"] - 1.0
    assert row["added_p99_ms"] == row["p99_ms"] - 2.0
    assert (row["offered_hz"], row["max_hz"], row["max_here_hz"]) == (40.0, 20.0, 40.0)
    text = target.read_text("utf-8")
    assert "| dask cluster on this machine, 2 workers, 90 directions, 4 × 10 Hz for 1 s |" in text
    assert "; 20 images/s of 40 offered, 40 with the node's own workers. Processor time in % of one core: " in text
    assert "; the cluster's scheduler and workers are not counted |" in text
