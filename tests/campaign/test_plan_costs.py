"""Plans are chosen by nominal costs unless measured ones are asked for."""

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.cpu_times import costs as bench_costs
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.campaign import Campaign, CampaignOptions, find_recordings
from ertis_numba.chain import costs, nominal_costs, planner
from ertis_numba.network.processing import ProcessingOptions as ServeOptions
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy
from ertis_numba.storage import open_energyscapes, open_recording, write_recording
from tests.cases import SHORT, noise
from tests.files import noise as many_noise
from tests.pages import ROOT, path_of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

CPU = kernels.load("cpu")
MANY = SHORT.replace(processing=SHORT.processing.replace(directions="3d:2000"), accuracy=Accuracy(max_error_db=-35.0))


def costs_where(dear, folder):
    """Write measured costs in which some kernels take much longer than all others."""
    seconds = {name: 1e-9 if name.startswith(dear) else 1e-15 for name in costs.UNITS}
    folder.mkdir()
    for threads in (1, CPU.max_threads):
        name = costs.cache_file("cpu", threads).name
        (folder / name).write_text(json.dumps(seconds), "utf-8")
    return folder


def plans_of_another_machine(folder, monkeypatch):
    """The nominal and the measured plan, without what this process knows about its own machine."""
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(folder))
    monkeypatch.setattr(costs, "_KNOWN", {})
    return [Pipeline(MANY, device="cpu", plan=plan).settings.to_toml() for plan in ("nominal", "measured")]


def test_machines_with_different_measured_costs_choose_the_same_plan_by_default(tmp_path, monkeypatch):
    folders = [costs_where(dear, tmp_path / dear) for dear in ("sum", "pair")]
    plans = [plans_of_another_machine(folder, monkeypatch) for folder in folders]
    (nominal, measured), (other_nominal, other_measured) = plans
    assert nominal == other_nominal
    assert measured != other_measured
    assert "beam_taps = 0" in other_measured


def test_default_plan_measures_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(costs, "_KNOWN", {})
    monkeypatch.setattr(costs, "measure", lambda *_: pytest.fail("costs were measured"))
    with Pipeline(SHORT, "cpu") as pipeline:
        pipeline.process(noise(SHORT))
    assert list(tmp_path.iterdir()) == []


def test_images_contain_the_chosen_plan(monkeypatch, tmp_path):
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(costs_where("pair", tmp_path / "pair")))
    monkeypatch.setattr(costs, "_KNOWN", {})
    with Pipeline(MANY, "cpu", plan="measured", predict=False) as pipeline:
        assert pipeline.settings.accuracy.beam_taps == 0
        assert pipeline.process(noise(MANY)).settings == pipeline.settings
    assert Pipeline(MANY, "cpu", predict=False).settings.accuracy.beam_taps > 0


def test_nominal_costs_do_not_depend_on_threads_or_hardware():
    plans = {planner.complete(MANY, CPU, threads=threads).to_toml() for threads in (1, CPU.max_threads)}
    assert len(plans) == 1
    assert costs.nominal_costs(CPU).seconds == nominal_costs.NOMINAL_COSTS[f"cpu {CPU.instruction_set}"]


@pytest.mark.parametrize(("instruction_set", "precision"), [("AVX2", "int16"), ("NEON", "float32"), ("new", "float32")])
def test_default_precision_is_the_fastest_of_the_instruction_set(instruction_set, precision):
    """An unknown instruction set has the costs of NEON."""
    kernel_set = dataclasses.replace(CPU, instruction_set=instruction_set)
    assert planner.complete(MANY, kernel_set, threads=1).accuracy.precision == precision


@pytest.fixture
def recording(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_CACHE_DIR", str(costs_where("pair", tmp_path / "cache")))
    monkeypatch.setattr(costs, "_KNOWN", {})
    return write_recording(tmp_path / "rec.h5", many_noise(count=2))


def made_by(tmp_path, *arguments):
    target = tmp_path / "img.h5"
    done = CliRunner().invoke(cli, ["process", *map(str, arguments), "-o", str(target), "--force"])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(target) as images:
        return images.settings.accuracy


@pytest.mark.parametrize("more", [[], ["--workers", "1"]])
def test_process_chooses_plans_by_the_given_costs(recording, tmp_path, more):
    grid = ["--directions", "3d:2000", "--range", "0.4:0.9", "--device", "cpu"]
    if not more:
        nominal, measured = (made_by(tmp_path, recording, *grid, "--plan", plan) for plan in costs.PLAN_COSTS)
        assert made_by(tmp_path, recording, *grid) == nominal
    else:
        write_recording(tmp_path / "other.h5", many_noise(count=1))
        nominal = planner.complete(MANY, CPU, threads=1).accuracy  # other campaigns have nominal plans
        options = CampaignOptions(
            settings=lambda recorded: recorded.replace(processing=MANY.processing), device="cpu", plan="measured"
        )
        paths = [tmp_path / "rec.h5", tmp_path / "other.h5"]
        campaign = Campaign(list(find_recordings(paths)), tmp_path / "images", options, workers=1)
        assert all(getattr(event, "outcome", "made") == "made" for event in campaign.run())
        with open_energyscapes(tmp_path / "images" / "rec.energy.h5") as images:
            measured = images.settings.accuracy
    assert nominal.beam_taps > 0
    assert measured.beam_taps == 0


def test_unknown_kinds_of_costs_are_refused():
    for call in (
        lambda: Pipeline(SHORT, "cpu", plan="fast"),
        lambda: CampaignOptions(plan="fast"),
        lambda: ServeOptions(plan="fast"),
        lambda: planner.complete(SHORT, CPU, threads=1, plan="fast"),
    ):
        with pytest.raises(ArgumentError, match=r"plan 'fast' is unknown.*; known are nominal, measured"):
            call()
    assert CliRunner().invoke(cli, ["process", "a.h5", "--plan", "fast"]).exit_code == 2


# ---- the table ---------------------------------------------------------------------------------------


def test_cost_table_equals_the_output_of_the_command():
    path = ROOT / "ertis_numba" / "chain" / "nominal_costs.py"
    assert path.read_text("utf-8") == bench_costs.as_python(nominal_costs.NOMINAL_COSTS)
    assert {name.split()[0] for name in nominal_costs.NOMINAL_COSTS} == set(kernels.DEVICES)
    assert f"cpu {CPU.instruction_set}" in nominal_costs.NOMINAL_COSTS
    for table in nominal_costs.NOMINAL_COSTS.values():
        assert set(table) == set(costs.UNITS)
        assert all(0 < value < 1 for value in table.values())


def test_costs_command_measures_and_updates_the_table(tmp_path, monkeypatch):
    seconds = dict.fromkeys(costs.UNITS, 1.23456e-9)
    monkeypatch.setattr(bench_costs, "measure", lambda *_: costs.Costs(seconds))
    monkeypatch.setattr(bench_costs.instruction_sets, "lesser", list)
    own = f"cpu {CPU.instruction_set}"
    path = tmp_path / "nominal_costs.py"
    path.write_text("")
    done = CliRunner().invoke(cli, ["bench", "costs", "--count", "1", "--update", str(path), "--json", "--quiet"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["costs"][own] == dict.fromkeys(costs.UNITS, 1.23e-9)
    made = {}
    exec(path.read_text("utf-8"), made)
    assert made["NOMINAL_COSTS"][own] == dict.fromkeys(costs.UNITS, 1.23e-9)
    assert made["NOMINAL_COSTS"]["cuda"] == nominal_costs.NOMINAL_COSTS["cuda"]
    done = CliRunner().invoke(cli, ["bench", "costs", "--count", "1", "--quiet"])
    assert f"| {own}, here | {own}, nominal |" in done.stdout
    assert "| sum_float32_few | 1.23 |" in done.stdout
    other = tmp_path / "README.md"
    other.write_text("")
    done = CliRunner().invoke(cli, ["bench", "costs", "--update", str(other)])
    assert done.exit_code == 1
    assert "no place for this table" in done.stderr.replace("\n", " ")
    other = tmp_path / "costs.py"
    other.write_text("")
    done = CliRunner().invoke(cli, ["bench", "costs", "--update", str(other)])
    assert done.exit_code == 2
    assert "costs.py is not nominal_costs.py" in done.stderr.replace("\n", " ")


def test_costs_of_some_units_are_scaled_to_the_machine_of_the_others(tmp_path, monkeypatch):
    own, reference = f"cpu {CPU.instruction_set}", "sum_float32_few"
    nominal, asked = nominal_costs.NOMINAL_COSTS[own], []

    def measured(_kernels, _threads, units):
        asked.append(set(units))
        return costs.Costs({name: 3e-9 if name == reference else 6e-9 for name in units})

    monkeypatch.setattr(bench_costs, "measure", measured)
    monkeypatch.setattr(bench_costs.instruction_sets, "lesser", list)
    path = tmp_path / "nominal_costs.py"
    path.write_text("")
    options = ["bench", "costs", "--count", "1", "--unit", "shift", "--quiet"]
    done = CliRunner().invoke(cli, [*options, "--json", "--update", str(path)])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["costs"][own]
    assert found == {"shift": pytest.approx(2 * nominal[reference], rel=5e-3)}
    assert {frozenset(units) for units in asked} == {frozenset({"shift", reference})}
    made = {}
    exec(path.read_text("utf-8"), made)
    assert made["NOMINAL_COSTS"][own] == nominal | found
    table = CliRunner().invoke(cli, options).stdout
    assert "| shift |" in table
    assert "| level |" not in table
    done = CliRunner().invoke(cli, ["bench", "costs", "--unit", "shifts"])
    assert done.exit_code == 2
    assert "unit 'shifts' is unknown; known are call, " in done.stderr.replace("\n", " ")


def test_documented_costs_are_the_nominal_ones():
    table = bench_costs.nominal_as_markdown(nominal_costs.NOMINAL_COSTS)
    assert table in path_of("accuracy").read_text("utf-8")


def test_documented_times_of_a_board_follow_from_its_costs():
    kernel_set, rows = dataclasses.replace(CPU, instruction_set="NEON"), []
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        settings = recording.settings
    for n_directions in (90, 1850, 3000):
        made = planner.complete(settings.replace("processing.directions", str(n_directions)), kernel_set, threads=1)
        times_ms = planner.Planner(made, kernel_set, threads=1).chosen(made.accuracy).stages_ms.values()
        rows.append(f"| {n_directions} | {sum(times_ms):.0f} |")
    assert "\n".join(rows) in path_of("single-board").read_text("utf-8")


def test_plans_differ_only_in_time():
    """Both keep the budget, for any costs."""
    images = {}
    for plan in costs.PLAN_COSTS:
        with Pipeline(SHORT, "cpu", plan=plan, predict=False) as pipeline:
            images[plan] = np.asarray(pipeline.process(noise(SHORT))).astype(float)
    difference = np.linalg.norm(images["nominal"] - images["measured"]) / np.linalg.norm(images["nominal"])
    assert 20 * np.log10(max(difference, 1e-9)) < SHORT.accuracy.max_error_db + 6
