"""``ertis bench many`` compares all pools, and refuses to time failed or differing output."""

import json

import pytest
from click.testing import CliRunner
from ertis_bench.cpu_times import campaign_scaling
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from ertis_numba.campaign import Campaign
from tests.campaigns import InlinePool
from tests.dask_clusters import cluster_of_threads


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(campaign_scaling, "_MEASUREMENTS", 2)
    monkeypatch.setattr(campaign_scaling, "_cores", lambda: 1)
    monkeypatch.setattr(campaign_scaling.cluster, "local_cluster", cluster_of_threads)


def test_all_pools_are_timed_and_compared(tmp_path, monkeypatch):
    pool = Campaign._pool  # noqa: SLF001
    chosen = lambda campaign: pool(campaign) if vars(campaign)["_scheduler"] else InlinePool()  # noqa: E731
    monkeypatch.setattr(Campaign, "_pool", chosen)  # processes start slowly, and other tests cover them
    target = tmp_path / "page.md"
    target.write_text("<!-- ertis bench many -->\nold\n<!-- /ertis bench many -->\n", "utf-8")
    done = CliRunner().invoke(
        cli, ["bench", "many", "--count", "2", "--rounds", "1", "--json", "--quiet", "--update", str(target)]
    )
    assert done.exit_code == 0, (done.stderr, done.exception)
    rows = {row["crew"]: row for row in json.loads(done.stdout)["rows"]}
    assert list(rows) == ["1 worker of 1 thread", "dask's LocalCluster, 1 workers of 1 thread"]
    assert rows["1 worker of 1 thread"]["times_faster"] == 1.0
    assert all(0 < row["working_s"] <= row["seconds"] for row in rows.values())
    text = target.read_text("utf-8")
    assert "| 1 worker of 1 thread | " in text
    assert "2 recordings of 2 measurements of data/synthetic/reflectors.h5" in text


def test_more_cores_give_more_pools(monkeypatch):
    monkeypatch.setattr(campaign_scaling, "_cores", lambda: 4)
    crews = campaign_scaling._crews  # noqa: SLF001
    assert [tuple(pool.values()) for pool in crews("tcp://x:1").values()] == [
        (1, 1),
        (1, 4),
        (4, 1),
        (4, 4),
        ("tcp://x:1",),
    ]


def test_differing_files_are_not_timed(tmp_path, monkeypatch):
    def timed(_, target, *, workers, threads):
        (target / "000.energy.h5").write_text(f"{workers} {threads}")
        (target / "001.energy.h5").write_text("x" * workers)
        (target / "002.energy.h5").write_text("the same")
        return 1.0, 1.0

    monkeypatch.setattr(campaign_scaling, "_timed", timed)
    monkeypatch.setattr(campaign_scaling, "_require_exact", lambda *_: None)
    crews = {"one": {"workers": 1, "threads": 1}, "two": {"workers": 2, "threads": 1}}
    message = (
        r"files of two differ from those of 1 worker of 1 thread \(000\.energy\.h5: 1 of 3 bytes differ, from 0 to 0, "
        r"001\.energy\.h5: 2 bytes instead of 1\); do not use it"
    )
    with pytest.raises(DataError, match=message):
        campaign_scaling._measured(  # noqa: SLF001
            tmp_path, tmp_path / "out", crews, 1, lambda _: None
        )


def test_failing_recording_is_not_timed(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "torn.h5").write_bytes(b"torn")
    with pytest.raises(DataError, match=r"torn\.h5 is failed \(.*not an HDF5 file.*\), so it is not timed"):
        campaign_scaling._timed(tmp_path / "runs", tmp_path / "out", workers=1)  # noqa: SLF001
