"""Benchmarks measure as documented, refuse wrong results, and write their tables to the markers."""

import functools
import itertools
import json
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench import (
    accuracy,
    checks,
    input_measurements,
    instruction_sets,
    machine,
    markdown,
    paper,
    plans,
    timing,
)
from ertis_bench.cpu_times import beamformers, scaling
from ertis_bench.simulation_trials import simulation
from ertis_cli.main import cli

from ertis_numba import figures, kernels
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.kernels.benchmarks import ceilings_of_cpu as ceilings
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.prediction import Prediction
from ertis_numba.settings import ERROR_PRESETS_DB
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.simulation import Point
from ertis_numba.simulation.effects import EFFECTS
from tests.cases import SHORT, noise
from tests.hard_cases.forced import EIGHT
from tests.pages import path_of
from tests.scenes import scene_of

MARKED = "# Mine\n\n<!-- ertis bench {0} -->\nold\n<!-- /ertis bench {0} -->\n\nrest\n"


@pytest.fixture(scope="module")
def image():
    return Pipeline(SHORT).process(noise(SHORT))


@pytest.fixture
def hardly_warm(monkeypatch):
    """Warm up with one call: these tests check the timing code, not the times."""
    monkeypatch.setattr(timing, "_WARM_UP", 1)
    monkeypatch.setattr(timing, "_WARM_UP_S", 0.0)


def test_subjects_take_turns_in_bursts_after_warming_up(monkeypatch):
    monkeypatch.setattr(timing, "_WARM_UP_S", 0.0)
    calls, clock_ns = [], itertools.count(0, 500_000)  # each look at the clock is half a millisecond later
    monkeypatch.setattr(
        timing, "time", types.SimpleNamespace(perf_counter=lambda: 0.0, perf_counter_ns=clock_ns.__next__)
    )
    subjects = {name: lambda name=name: calls.append(name) for name in "ab"}
    times_ms = timing.round_robin(subjects, count=timing.BURST + 2)
    assert "".join(calls) == "aaa" + "a" * timing.BURST + "bbb" + "b" * timing.BURST + "aaaaa" + "bbbbb"
    assert {name: times.tolist() for name, times in times_ms.items()} == dict.fromkeys("ab", [0.5] * (timing.BURST + 2))


def test_summary_is_mean_deviation_and_median():
    assert timing.summary(np.array([1.0, 2.0, 6.0])) == {"mean_ms": 3.0, "std_ms": 2.16, "median_ms": 2.0}


def of_few_directions(settings, **options):
    """Return a pipeline of fewer directions, for tests of reports whose times do not matter."""
    count = 9 + int(settings.processing.directions) // 90
    return Pipeline(settings.replace(processing=settings.processing.replace(directions=f"2d:{count}")), **options)


@pytest.mark.usefixtures("hardly_warm")
def test_paper_command_reports_and_updates(monkeypatch, tmp_path):
    monkeypatch.setattr(paper, "Pipeline", of_few_directions)
    monkeypatch.setattr(paper, "RESTRICTED", ())  # another process would have all directions
    target = tmp_path / "README.md"
    target.write_text(MARKED.format("paper"), "utf-8")
    other = tmp_path / "other.md"
    other.write_text(MARKED.format("paper short"), "utf-8")
    files = ["--update", str(target), "--update", str(other)]
    result = CliRunner().invoke(cli, ["bench", "paper", "--count", "1", "--json", *files])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert {"cpu", "cores", "python", "numpy", "numba"} <= report["machine"].keys()
    assert [(row["backend"], row["directions"]) for row in report["rows"]] == [
        (backend, directions) for directions in (90, 1850, 3000) for backend in ("scipy", "paper", "numpy", "cpu")
    ]
    assert all(set(row) == {"backend", "directions", "mean_ms", "std_ms", "median_ms"} for row in report["rows"])
    assert all(row["median_ms"] > 0 for row in report["rows"])
    text = target.read_text("utf-8")
    assert text.startswith("# Mine\n\n<!-- ertis bench paper -->\n| ms, mean ± std (median) | 90 directions |")
    assert text.endswith("<!-- /ertis bench paper -->\n\nrest\n")
    assert "old" not in text
    assert "not measured" not in text
    assert "| GPU GTX 1080 Ti | 5.93 ± 0.66 | 51.58 ± 6.38 | 77.02 ± 7.81 |" in text
    assert "timing 1 of each" in result.stderr
    assert f"Numba, {kernels.load('cpu').instruction_set} |" in text
    short = other.read_text("utf-8")
    assert "| published in the paper, GPU GTX 1080 Ti | 5.9 | 51.6 | 77.0 |" in short
    medians = [f"{row['median_ms']:.1f}" for row in report["rows"] if row["backend"] == "cpu"]
    assert f"| this package, {kernels.load('cpu').instruction_set} | {' | '.join(medians)} |" in short


def test_paper_benchmark_times_another_process(monkeypatch):
    """The process has the instruction set of this one, so that it compiles nothing."""
    monkeypatch.setattr(instruction_sets, "environment", lambda _: {})
    with vars(paper)["_restricted"]("AVX2", 1) as child:
        row, error_db = vars(paper)["_ask"](child, 90)
    assert row["median_ms"] > 0
    assert error_db < -35
    broken, pipe = [sys.executable, "-c", "input()"], subprocess.PIPE
    with (
        subprocess.Popen(broken, stdin=pipe, stdout=pipe, text=True) as child,
        pytest.raises(DataError, match="the process with older instructions has failed"),
    ):
        vars(paper)["_ask"](child, 90)


@pytest.mark.skipif(not instruction_sets.lesser(), reason="this processor has no older instruction set")
def test_older_instruction_sets_are_those_of_the_environment():
    for name in instruction_sets.lesser():
        code = "from ertis_numba import kernels; print(kernels.load('cpu').instruction_set)"
        with instruction_sets.start(name, ["-c", code]) as child:
            assert child.communicate()[0].strip() == name


@pytest.mark.usefixtures("hardly_warm")
def test_scaling_measures_every_series(monkeypatch):
    series = {"directions": (90, 180), "last_range_m": (1.0,), "microphones": (40,)}
    monkeypatch.setattr(scaling, "SERIES", series)
    monkeypatch.setattr(scaling, "_BASE", {"directions": 90, "last_range_m": 1.5, "microphones": 32})
    monkeypatch.setattr(scaling, "_PRESET", "short_25_50")
    monkeypatch.setattr(scaling, "_STREAM", 2**16)
    monkeypatch.setattr(scaling, "_TURNS", 10_000)
    report = scaling.run(count=1, say=lambda _: None)
    found = {(row["series"], row["plan"], row["value"]) for row in report["rows"]}
    assert {
        ("directions", "default", 90.0),
        ("directions", "float32", 90.0),
        ("directions", "float32", 180.0),
        ("last_range_m", "default", 1.0),
        ("microphones", "default", 40.0),
        ("threads", "default", 1.0),
    } <= found
    rates = report["ceilings"][-1]
    assert rates["float32_gop_s"] > 1
    assert rates["int16_gop_s"] < 20 * rates["float32_gop_s"]  # 300 times if the compiler removes the loop
    assert report["delay_and_sum"][0]["precision"] == "float32"
    text = scaling.form(report)
    for name in ("directions", "directions, no beam grid, float32", "last range, m", "microphones", "threads"):
        assert f"| {name} | ms, mean ± std (median) | ranges |" in text


def test_delay_and_sum_is_the_slope_over_directions():
    rows = [
        {"series": series, "plan": "int16", "value": n, "n_ranges": 1000, "median_ms": 2.0 + n / 1000}
        for series, n in (("directions", 100), ("directions", 1000), ("directions", 5000), ("threads", 1))
    ]
    found = scaling.reached(rows, "int16", {"copy_gb_s": 40.0, "int16_gop_s": 512.0})
    assert found["us_per_direction"] == pytest.approx(1.0)
    assert found["rest_of_chain_ms"] == pytest.approx(2.0)
    assert found["gop_s"] == pytest.approx(256.0)  # 1000 ranges, 32 microphones, 8 operations in a microsecond
    assert found["of_arithmetic"] == pytest.approx(0.5)
    assert found["of_copy"] == pytest.approx(0.2)  # 4 GB/s of the 20 that a copy writes


def test_correct_image_passes_with_its_error(image):
    assert -60 < checks.require_exact(image, noise(SHORT)) < checks.MAX_ERROR_DB
    checks.require_same_reflector(image, image)


@pytest.mark.parametrize(
    "wrong", [lambda e: 1.1 * e, lambda e: np.roll(e, 1, axis=1), lambda e: np.full_like(e, np.nan)]
)
def test_benchmark_refuses_a_wrong_image(image, wrong):
    with pytest.raises(DataError, match=r"image of 7 directions has an error of .* dB .*; the limit is -30 dB"):
        checks.require_exact(image.replace(amplitude=wrong(image.amplitude)), noise(SHORT))


@pytest.mark.parametrize("shift", [(3, 0), (0, 30)])
def test_benchmark_refuses_another_strongest_reflector(image, shift):
    amplitude = np.full_like(image.amplitude, 0.1)
    amplitude[2, 50] = 1.0
    with pytest.raises(DataError, match=r"strongest reflector of one image, at 0.591 m, has -20.0 dB in the other"):
        checks.require_same_reflector(
            image.replace(amplitude=amplitude), image.replace(amplitude=np.roll(amplitude, shift, axis=(0, 1)))
        )


def test_update_refuses_a_file_without_markers(tmp_path):
    target = tmp_path / "a.md"
    with pytest.raises(ArgumentError, match=r"a\.md: .*No such file.*; choose a readable Markdown file"):
        markdown.update(target, "ertis bench paper", "x")
    target.write_text(MARKED.format("scaling"), "utf-8")
    with pytest.raises(ArgumentError, match=r"no place for this table; .* <!-- ertis bench paper --> and <!-- /ertis"):
        markdown.update(target, "ertis bench paper", "x")
    markdown.update(target, "ertis bench scaling", "| new |\n")
    markdown.update(target, "ertis bench scaling", "| new |")
    assert target.read_text("utf-8") == MARKED.format("scaling").replace("old", "| new |")


def test_partial_table_never_replaces_the_complete_one(tmp_path):
    target = tmp_path / "a.md"
    target.write_text(MARKED.format("network"), "utf-8")
    assert markdown.place(target, "ertis bench", ["network"]) == ("network", "ertis bench network")
    with pytest.raises(ArgumentError, match=r"for this table; .* <!-- ertis bench network --only storage -->"):
        markdown.place(target, "ertis bench", ["network"], ["storage"])
    target.write_text(MARKED.format("network --only storage"), "utf-8")
    placed = markdown.place(target, "ertis bench", ["network"], ["storage"])
    assert placed == ("network", "ertis bench network --only storage")


def test_file_without_markers_is_refused_before_measuring(tmp_path):
    target = tmp_path / "a.md"
    target.write_text("nothing", "utf-8")
    result = CliRunner().invoke(cli, ["bench", "paper", "--count", "1", "--update", str(target)])
    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1].startswith(f"ertis: error: {target} has no place for this table")
    assert "timing" not in result.stderr


def test_subject_is_the_shipped_recording_or_noise(monkeypatch):
    measurement, source = input_measurements.measurement()
    assert source == "data/synthetic/reflectors.h5"
    assert measurement.data.shape == (163_840,)
    monkeypatch.setattr(input_measurements, "_RECORDING", Path("nowhere.h5"))
    measurement, source = input_measurements.measurement()
    assert source == "white noise, seed 1"
    assert measurement.data.shape == (163_840,)


def test_reports_name_the_machine(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    found = machine.describe()
    assert found["cores"] >= 1
    assert machine.sentence(found).startswith(found["cpu"])
    assert "OPENBLAS_NUM_THREADS=1" in machine.sentence(found)
    monkeypatch.setattr(machine, "_processor", dict)
    assert machine.describe()["cpu"]


def test_ceilings_compute():
    source, out = np.arange(1000, dtype=np.float32), np.zeros(1000, dtype=np.float32)
    ceilings.copy(source, out)
    assert np.array_equal(out, source)
    ceilings.triad(source, source, np.float32(2), out)
    assert np.array_equal(out, 3 * source)
    strands = np.zeros(3, dtype=np.float32)
    ceilings.multiply_add(100, strands)  # each of twelve sums tends to 1 / (1 - 1/2)
    assert strands == pytest.approx(24)


def test_ceiling_of_dot_products_computes():
    strands = np.zeros(3, dtype=np.int32)
    ceilings.dot_16(100, strands)
    sums = np.arange(12, dtype=np.int32)
    for _ in range(100):  # the low half of each sum times 1, and the high half times 3
        low, high = sums.view(np.int16).reshape(12, 2).astype(np.int32).T
        sums += low + 3 * high
    assert strands.tolist() == [sums.sum(dtype=np.int32)] * 3


def test_published_times_have_one_entry_per_configuration():
    assert paper.DIRECTIONS == (90, 1850, 3000)
    assert all(len(times) == len(paper.DIRECTIONS) for times in paper.PUBLISHED_MS.values())


@pytest.mark.parametrize("name", ["paper", "peers", "accuracy", "scaling"])
def test_generated_readme_has_all_tables(name):
    text = path_of("benchmarks").read_text("utf-8")
    table = text.partition(f"<!-- ertis bench {name} -->")[2].partition(f"<!-- /ertis bench {name} -->")[0]
    assert "| ---: |" in table


@pytest.mark.usefixtures("hardly_warm")
def test_beamformers_benchmark_rates_every_combination(tmp_path):
    target = tmp_path / "page.md"
    target.write_text(MARKED.format("beamformers"), "utf-8")
    arguments = ["bench", "beamformers", "--count", "1", "--directions", "2d:46", "--json", "--update", str(target)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, (done.output, done.exception)
    rows = json.loads(done.stdout)["rows"]
    combinations = {(row["beamformer"].partition(",")[0], row["weighting"]) for row in rows}
    assert combinations == {("delay_and_sum", "none"), *ADAPTIVE_COMBINATIONS}
    assert rows[0]["relative_time"] == 1.0
    for row in rows:
        assert row["relative_time"] == pytest.approx(row["median_ms"] / rows[0]["median_ms"])
        assert row["error_db"] <= ERROR_PRESETS_DB["draft"]
        # Errors of adaptive beamformers are predicted from a sample, by up to 2 dB too low.
        assert -2 < row["predicted_db"] - row["error_db"] < 3, row
    table = target.read_text("utf-8")
    assert table.count("\n| `") == len(rows)
    assert f"\n| `dmas`, order 5 | `coherence_factor` | {rows[5]['relative_time']:.1f} |" in table
    assert "\nold\n" not in table


@pytest.mark.parametrize(("predicted_db", "limit_db"), [(-40.0, -35.0), (-30.0, -29.0), (-10.0, -20.0)])
def test_beamformers_benchmark_refuses_unexpected_errors(predicted_db, limit_db, monkeypatch):
    monkeypatch.setattr(verification, "measure", lambda *_: verification.Measured(limit_db + 0.1, 1, None))
    monkeypatch.setattr(beamformers, "predict", lambda *_: Prediction(predicted_db, -35.0))
    reported = rf"image of delay_and_sum with weighting none has an error of {limit_db + 0.1:.1f} dB .* {limit_db:g} dB"
    with pytest.raises(DataError, match=reported):
        beamformers.run(count=1, say=lambda _: None, directions="2d:10")


FEW = [("float32", 1, 2, 40.0, None), ("float32", 3, 4, 80.0, None), ("int16", 2, 2, 40.0, (4, 1.75))]


@pytest.fixture
def quick(monkeypatch, hardly_warm):  # noqa: ARG001 - it is used by what it does
    """Use few plans and hardly any warm-up."""
    monkeypatch.setattr(plans, "PLANS", FEW)


def bench_accuracy(*arguments):
    done = CliRunner().invoke(cli, ["bench", "accuracy", "--count", "1", "--directions", "2d:46", *map(str, arguments)])
    assert done.exit_code == 0, (done.output, done.exception)
    return done


@pytest.mark.usefixtures("quick")
def test_accuracy_rates_every_plan_on_both_subjects(tmp_path):
    full, short, picture = tmp_path / "full.md", tmp_path / "short.md", tmp_path / "front.png"
    full.write_text(MARKED.format("accuracy"), "utf-8")
    short.write_text(MARKED.format("accuracy front"), "utf-8")
    done = bench_accuracy("--json", "--update", full, "--update", short, "--plot", picture)
    report = json.loads(done.stdout)
    assert [entry["subject"] for entry in report["subjects"]] == ["real", "synthetic"]
    for subject_name in ("real", "synthetic"):
        rows = [row for row in report["rows"] if row["subject"] == subject_name]
        names = [row["plan"].partition(":")[0] for row in rows]
        assert {accuracy.PAPER, *ERROR_PRESETS_DB} <= set(names)
        assert "float32, 1 sample of 2 per range, 40 dB" in names
        assert [row["error_db"] for row in rows] == sorted((row["error_db"] for row in rows), reverse=True)
        for row in rows:
            assert row["time_ms"] > 0
            if row["plan"] == accuracy.PAPER:
                assert row["predicted_db"] is None
                assert not row["on_front"]
            else:
                assert abs(row["predicted_db"] - row["error_db"]) < 3, row
        budgets = {row["plan"].partition(":")[0]: row["error_db"] for row in rows}
        assert all(budgets[preset] <= max_error_db for preset, max_error_db in ERROR_PRESETS_DB.items())
        exact_row = rows[-1]
        assert exact_row["on_front"]  # nothing is more exact
        assert exact_row["peaks_lost"] == 0
        assert exact_row["peak_level_db"] <= 0.001  # -100 dB of the strongest are more of a faint one
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert full.read_text("utf-8").count("the paper's method |") == 2
    for row in report["rows"]:  # a plan on the front, which depends on measured times, is in bold
        assert (f"| **{row['plan']}** |" if row["on_front"] else f"| {row['plan']} |") in full.read_text("utf-8")
    assert "docs/reference/benchmarks.md has all plans" in short.read_text("utf-8")
    assert "\nold\n" not in full.read_text("utf-8") + short.read_text("utf-8")


@pytest.mark.usefixtures("quick")
def test_accuracy_benchmark_lists_omissions(monkeypatch):
    monkeypatch.setattr(input_measurements, "_DISTRIBUTION", "no-such-distribution")
    monkeypatch.setattr(plans, "PLANS", FEW[:1])
    done = bench_accuracy()
    assert "real measurement: skipped, because its package rtisdev is not installed" in done.stderr
    assert (
        "reflectors without a peak from `find_peaks` within 5° and 2 cm. Not installed here: real measurement."
        in done.stdout
    )
    assert "| synthetic (data/synthetic/reflectors.h5) |" in done.stdout
    assert "| real" not in done.stdout


def test_pareto_front_contains_undominated_plans():
    row = {"error_db": -40.0, "time_ms": 3.0}
    assert accuracy.beats({"error_db": -41.0, "time_ms": 3.0}, row)
    assert accuracy.beats({"error_db": -40.0, "time_ms": 2.0}, row)
    assert not accuracy.beats(row, row)
    assert not accuracy.beats({"error_db": -50.0, "time_ms": 3.1}, row)


def test_pareto_front_is_drawn_as_a_labelled_line():
    rated = functools.partial(figures.Rated, series="room", time_ms=2.0)
    points = [rated(error_db=-20.0, on_front=True, label="draft"), rated(error_db=-10.0, on_front=False)]
    points += [rated(error_db=-60.0, on_front=True), rated(series="hall", error_db=-30.0, on_front=True)]
    axes = figures.front(points, title="T", note="N").axes[0]
    assert [line.get_xdata().tolist() for line in axes.lines] == [[-10.0], [-60.0, -20.0], [], [-30.0]]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["room", "hall"]
    assert [text.get_text() for text in axes.texts] == ["draft"]
    with pytest.raises(ArgumentError, match="theme 'blue' is unknown"):
        figures.front(points, title="T", theme="blue")


@pytest.mark.usefixtures("hardly_warm")
def test_simulation_benchmark_times_free_field_and_all_effects(tmp_path, monkeypatch):
    """The times are processor times, at least the times on an idle machine, so that other work does not matter."""
    clock = types.SimpleNamespace(perf_counter=time.perf_counter, perf_counter_ns=time.process_time_ns)
    monkeypatch.setattr(timing, "time", clock)
    target = tmp_path / "README.md"
    target.write_text(MARKED.format("simulation"), "utf-8")
    result = CliRunner().invoke(cli, ["bench", "simulation", "--count", "1", "--json", "--update", str(target)])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    needed, everything = report["rows"]
    assert needed["on"] == ["propagation", "spreading", "absorption", "modulation"]
    assert set(needed["cost_ms"]) <= set(needed["on"])  # what is not needed costs nothing
    assert set(everything["on"]) == {*EFFECTS} - {"microphone_faults"}
    assert report["change_db"] < 0.1
    assert report["times_faster"] > 3
    assert needed["median_ms"] < 200  # 5 measurements per second
    assert "Time with all effects / time with the relevant effects: " in target.read_text("utf-8")


def test_simulation_benchmark_refuses_differing_images(monkeypatch):
    monkeypatch.setattr(simulation, "image_change_db", lambda *_, **__: 9.0)
    monkeypatch.setattr(simulation, "free_field", lambda: scene_of(Point(range_m=0.5), sensor=EIGHT))
    with pytest.raises(DataError, match=r"change the image by 9\.00 dB; the limit is .* dB\. Do not use these times"):
        simulation.run(count=1, say=lambda _: None)
