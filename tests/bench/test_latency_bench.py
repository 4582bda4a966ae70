"""``ertis bench latency``, with a short measurement, fills its table."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest
from click.testing import CliRunner
from ertis_bench.network import imaging, latency
from ertis_bench.network.processor_time import ProcessorTime
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError
from ertis_numba.network import trace


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(imaging, "_WARM_UP_S", 0.4)


@pytest.mark.alone  # the limit of the serial line is a wall-clock time
def test_latency_bench_reports_every_stage_and_updates_the_page(tmp_path):
    target = tmp_path / "page.md"
    target.write_text("<!-- ertis bench latency -->\nold\n<!-- /ertis bench latency -->\n", "utf-8")
    options = ["--duration", "2", "--json", "--quiet", "--update", str(target)]
    done = CliRunner().invoke(cli, ["bench", "latency", *options])
    assert done.exit_code == 0, (done.stderr, done.exception)
    report = json.loads(done.stdout)
    cases = report["cases"]
    assert report["serial"]["blocks"] == 24
    assert all(0 < report["serial"][name]["p50_ms"] < 1000 for name in ("streamed", "whole"))
    assert [stage for stage, *_ in cases["images"]["stages"]] == list(latency.STAGES)
    stages = [stage for stage, *_ in cases["images and storage"]["stages"]]
    assert stages == [*latency.STAGES, "stored", "acknowledged"]
    for case in cases.values():
        since_ms = [time_ms for stage, _, _, time_ms in case["stages"] if stage in latency.STAGES]
        assert since_ms == sorted(since_ms)
        assert since_ms[-1] == pytest.approx(case["p50_ms"], abs=1.0)
        assert case["cpu_total_ms"] == pytest.approx(sum(time_ms for *_, time_ms in case["cpu_ms"]))
        assert {process for process, _, _ in case["cpu_ms"]} == {
            "central node",
            "workers",
            "publisher",
            "sensor nodes",
            "application",
        }
        assert case["wrong"] == case["uncounted"] == case["untold"] == 0
    text = target.read_text("utf-8")
    assert "| central node, archive | journal, fsync |" in text
    assert "**Serial line** of 20 MB/s, without a network: last byte of a block to its image p50 " in text
    assert "**Images and storage**: last byte to application p50 " in text


def test_processor_time_separates_threads_of_this_process():
    used = ProcessorTime({"this": [os.getpid()]})

    def work():
        begun_s = time.thread_time()
        while time.thread_time() - begun_s < 0.1:
            pass
        release.wait()

    release = threading.Event()
    thread = threading.Thread(target=work)
    thread.start()
    try:
        for _ in range(6000):
            rows = {kind: time_ms for _, kind, time_ms in used.rows(2)}
            if rows["other threads"] >= 45:
                break
            time.sleep(0.01)
    finally:
        release.set()
        thread.join()
    assert 45 <= rows["other threads"] < 200
    assert sum(time_ms for _, kind, time_ms in used.rows(2) if kind == "other threads") >= 45  # The thread has ended.
    assert used.percent()["this"] > 0


def test_trace_writes_one_line_per_mark(tmp_path):
    writer = trace.TraceWriter(tmp_path)
    writer("sent", "front", 3)
    writer("sent", "left", 4)
    (path,) = tmp_path.glob("*.trace")
    lines = [line.split("\t") for line in path.read_text("utf-8").splitlines()]
    assert [line[:3] for line in lines] == [["sent", "front", "3"], ["sent", "left", "4"]]
    assert int(lines[0][3]) <= int(lines[1][3])
    assert trace.mark is trace.ignore


def test_trace_to_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(
        ArgumentError, match=r"ERTIS_TRACE is .*missing', which is not a folder .*; create it, or unset"
    ):
        trace.TraceWriter(tmp_path / "missing")
    done = subprocess.run(
        [sys.executable, "-m", "ertis_cli", "listen", "tcp://127.0.0.1:9"],
        env={**os.environ, trace.VARIABLE: str(tmp_path / "missing")},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    (line,) = done.stderr.splitlines()
    assert (done.returncode, line.startswith("ertis: error: ERTIS_TRACE is")) == (1, True)


def test_trace_omits_marks_that_cannot_be_written(tmp_path):
    (tmp_path / "kept").mkdir()
    writer = trace.TraceWriter(tmp_path / "kept")
    (tmp_path / "kept").rename(tmp_path / "moved")
    writer("sent", "front", 3)
    (tmp_path / "kept").mkdir()
    writer("sent", "front", 4)
    (path,) = (tmp_path / "kept").iterdir()
    assert path.read_text("utf-8").startswith("sent\tfront\t4\t")
