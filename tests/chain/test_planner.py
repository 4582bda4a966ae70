"""Plans keep the budget by the true error, keep given choices, and trade accuracy for time."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import planner
from ertis_numba.chain.planner import Planner, complete
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import ERROR_PRESETS_DB, Accuracy, Array, Call, Processing
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from tests import error_cases, reference
from tests.cases import CASES, LINE_8, SHORT, noise
from tests.hard_cases.tuned import tuned

CPU = kernels.load("cpu")
SMALL = SHORT.replace(processing=SHORT.processing.replace(directions="3d:300"), accuracy=Accuracy())


def is_complete(accuracy):
    """Return True if a plan leaves nothing open."""
    return accuracy.precision != "auto" and None not in (
        accuracy.oversampling,
        accuracy.delay_taps,
        accuracy.beam_taps,
        accuracy.beam_density,
        accuracy.stopband_attenuation_db,
        accuracy.focal_zones,
    )


def chosen_for(settings, *, threads=1, **pinned):
    return Planner(tuned(settings, **pinned), CPU, threads=threads).choose()


def random_settings(seed):
    """Random array, grid, call and budget."""
    random = np.random.default_rng(seed)
    extent_m = random.uniform(0.01, 0.08, 3) * (1, 1, random.random() < 0.3) * (random.random(3) < 0.9)
    positions_m = random.uniform(-0.5, 0.5, (random.integers(1, 33), 3)) * extent_m[::-1]
    call = (
        Call(start_frequency_hz=float(random.uniform(45e3, 85e3)), stop_frequency_hz=float(random.uniform(18e3, 35e3)))
        if random.random() < 0.5
        else Call()
    )
    return SHORT.replace(
        array=Array(layout="random", positions_m=tuple(map(tuple, positions_m.tolist())), word_bits=32),
        call=call,
        processing=Processing(
            directions=f"{random.choice(['2d', '3d'])}:{random.integers(1, 400)}",
            range_m=(0.3, float(random.uniform(0.32, 1.0))),
            range_decimation=int(random.choice([20, 40, 100])),
            wavefront="plane",
        ),
        accuracy=Accuracy(max_error_db=float(random.uniform(-95, -15))),
    )


@pytest.mark.parametrize("seed", range(40))
def test_true_error_keeps_the_budget(seed):
    """The input is noise in the whole band, independent between microphones."""
    settings, measurement = random_settings(seed), noise(random_settings(seed), seed)
    chosen = chosen_for(settings)
    images = [
        error_cases.image_of(measurement, settings.replace(accuracy=plan)).astype(float)
        for plan in (chosen.settings.accuracy, error_cases.BEST)
    ]
    assert chosen.error_db <= settings.accuracy.max_error_db
    assert reference.error_db(*images) < settings.accuracy.max_error_db


@pytest.mark.parametrize("device", ["cpu", "numpy"])
@pytest.mark.parametrize("budget_db", ERROR_PRESETS_DB.values())
def test_pipelines_of_all_presets_keep_their_budget(device, budget_db):
    measurement = noise(SHORT)
    pipeline = Pipeline(SHORT, device=device, max_error_db=budget_db, predict=False)
    assert is_complete(pipeline.settings.accuracy)
    assert pipeline.settings.accuracy.max_error_db == budget_db
    exact = error_cases.image_of(measurement, SHORT.replace(accuracy=error_cases.BEST))
    assert reference.error_db(pipeline.process(measurement).amplitude.astype(float), exact.astype(float)) < budget_db


@pytest.mark.parametrize(
    "pinned",
    [
        {"precision": "float32"},
        {"oversampling": 7},
        {"delay_taps": 5},
        {"beam_taps": 0},
        {"beam_taps": 6},
        {"beam_density": 2.2},
        {"beam_taps": 4, "beam_density": 3.5, "oversampling": 3, "delay_taps": 3},
        {"stopband_attenuation_db": 77.0},
        {"focal_zones": 3},
    ],
)
def test_given_choices_are_kept(pinned):
    found = chosen_for(SMALL, **pinned).settings.accuracy
    assert is_complete(found)
    assert {name: getattr(found, name) for name in pinned} == pinned


@pytest.mark.parametrize("precision", ["float32", "int16"])
def test_given_precision_is_kept(precision):
    assert chosen_for(SMALL, precision=precision).settings.accuracy.precision == precision


@pytest.mark.parametrize(
    ("pinned", "part"),
    [
        ({}, "single precision"),
        ({"delay_taps": 1, "oversampling": 12}, "interpolation of delayed samples"),
        ({"beam_taps": 2, "beam_density": 1.5}, "interpolation between beam-grid points"),
        ({"stopband_attenuation_db": 40.0}, "noise aliased by the decimation"),
    ],
)
def test_unreachable_budget_is_refused_with_the_smallest_error(pinned, part):
    with pytest.raises(
        ArgumentError, match=rf"max_error_db is -160, but the smallest error .* due to {part}\); use -\d+ or"
    ) as no:
        chosen_for(SMALL, max_error_db=-160.0, **pinned)
    min_db = float(str(no.value).partition("; use ")[2].split()[0])
    assert chosen_for(SMALL, max_error_db=min_db, **pinned).error_db <= min_db
    with pytest.raises(ArgumentError, match="but the smallest error"):
        chosen_for(SMALL, max_error_db=min_db - 1.01, **pinned)


@pytest.mark.parametrize("name", ["default", "wide band", "solid angle", "line of 8", "64 bits, two words"])
def test_larger_budget_is_never_slower(name):
    settings = CASES[name].replace(processing=CASES[name].processing.replace(directions="3d:500"))
    threads = CPU.max_threads  # plans are chosen by what they cost with all of them
    times_ms = [
        chosen_for(settings, threads=threads, max_error_db=float(budget_db)).time_ms for budget_db in range(-100, 0, 15)
    ]
    assert (np.diff(times_ms) <= 1e-9).all()
    assert times_ms[-1] < 0.7 * times_ms[0]


def test_equal_costs_give_equal_plans():
    plans = {chosen_for(SMALL, max_error_db=budget_db).settings for budget_db in (-35.0, -60.0, -35.0, -60.0)}
    assert len(plans) == 2


@pytest.mark.parametrize(
    ("dear", "n_taps", "has_grid"),
    [
        (("sum", "shift"), {1, 2, 3, 4, 5, 6}, True),
        (("pair", "shift"), {1, 2, 3, 4, 5, 6}, False),
        (("sum", "pair"), {0}, False),
    ],
)
def test_costs_select_the_plan(monkeypatch, dear, n_taps, has_grid):
    """Beams are interpolated if only sums take time, and summed as spectra if only phase shifts take none."""
    usual = planner.nominal_costs(CPU)
    many = SMALL.replace(processing=SMALL.processing.replace(directions="3d:2000"))
    seconds = {name: 1e-9 if name.startswith(dear) else 1e-15 for name in usual.seconds}
    monkeypatch.setattr(planner, "nominal_costs", lambda _kernels: type(usual)(seconds))
    found = chosen_for(many).settings.accuracy
    assert found.delay_taps in n_taps
    assert bool(found.beam_taps) == has_grid


def test_complete_plans_are_kept():
    settings = SMALL.replace(accuracy=error_cases.BEST)
    assert is_complete(settings.accuracy)
    assert complete(settings, CPU, threads=1) == settings
    done = complete(SMALL, CPU, threads=1)
    assert is_complete(done.accuracy)
    assert done.replace(accuracy=SMALL.accuracy) == SMALL
    assert complete(done, CPU, threads=1) == done


def test_complete_plans_beyond_the_budget_are_refused():
    plan = error_cases.PLANS["delays 4 1"]
    assert complete(SMALL.replace(accuracy=plan.replace(max_error_db=-20.0)), CPU, threads=1)
    with pytest.raises(ArgumentError, match=r"max_error_db is -60, but the smallest error of these settings is -2\d"):
        complete(SMALL.replace(accuracy=plan.replace(max_error_db=-60.0)), CPU, threads=1)


def test_paper_method_has_no_plan():
    settings = SHORT.replace(processing=SHORT.processing.replace(method="paper"))
    assert complete(settings, CPU, threads=1) == settings
    assert Pipeline(settings).settings == settings


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_adaptive_beamformers_get_usable_plans(beamformer, weighting):
    settings = SMALL.replace(processing=SMALL.processing.replace(beamformer=beamformer, weighting=weighting))
    chosen = chosen_for(settings)
    assert is_complete(chosen.settings.accuracy)
    assert chosen.error_db <= settings.accuracy.max_error_db
    assert complete(chosen.settings, CPU, threads=1) == chosen.settings
    exact = chosen_for(settings, precision="float32").settings.accuracy
    assert (exact.precision, exact.delay_taps, exact.beam_taps) == ("float32", 1, 0)


def test_spherical_wavefronts_of_adaptive_beamformers_need_16_bits():
    settings = SMALL.replace(
        processing=SMALL.processing.replace(weighting="coherence_factor", wavefront="spherical"),
        accuracy=Accuracy(precision="float32"),
    )
    with pytest.raises(
        ArgumentError, match=r"'coherence_factor' needs 16-bit streams .*use processing.wavefront 'plane',"
    ):
        Planner(settings, CPU, threads=1).choose()


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_plans_of_former_files_keep_their_kernels(beamformer, weighting):
    """A complete plan of one sample per microphone, without a precision, is that of all microphones at once."""
    settings = SMALL.replace(processing=SMALL.processing.replace(beamformer=beamformer, weighting=weighting))
    former = {"oversampling": 32, "delay_taps": 1, "beam_taps": 0, "max_error_db": -20.0}
    assert chosen_for(settings, **former).settings.accuracy.precision == "float32"


def test_rated_plans_equal_requested_plans():
    """This holds for complete and incomplete settings."""
    for name in ("delays 4 1", "delays 4 4", "nodes 6 3", "nodes 2 2", "standard", "stop band 60"):
        plan = error_cases.PLANS[name].replace(max_error_db=-35.0)
        own = Planner(SMALL.replace(accuracy=plan), CPU, threads=1).chosen(plan)
        found = Planner(SMALL, CPU, threads=1).chosen(plan)
        assert (found.parts, found.stages_ms) == (own.parts, own.stages_ms)
        assert (found.parts["beams"] > 0) == bool(plan.beam_taps)


def test_lines_need_fewer_beam_grid_points_than_planes():
    line = SMALL.replace(array=Array(layout="line", positions_m=LINE_8, word_bits=8))
    assert (
        chosen_for(line, beam_taps=4).stages_ms["interpolation"]
        < chosen_for(SMALL, beam_taps=4).stages_ms["interpolation"]
    )
