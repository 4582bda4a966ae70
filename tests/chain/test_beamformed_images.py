"""Images by coherence factor, DMAS and Capon, and the choice of the beamformer."""

import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain import planner
from ertis_numba.chain.adaptive import AdaptiveBeamform
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.simulation import Point
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_energyscapes, write_recording
from tests import cases
from tests.files import noise
from tests.scenes import SENSOR, line_array, only, scene_of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

KERNELS = {name: kernels.load(name) for name in kernels.usable()}
LINE_16 = SENSOR.replace(
    array=line_array(16, 0.004),
    recording=Recording(n_samples=45_000),
    processing=Processing(directions="2d:361", range_m=(0.9, 1.4)),
)


@pytest.mark.parametrize("precision", ["float32", "int16"])
@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_beamformers_give_the_same_bits_on_any_number_of_threads(beamformer, weighting, precision):
    """In 16 bits, some numbers round the other way on another device."""
    if precision == "int16" and beamformer == "capon":
        pytest.skip("no kernel")
    settings = cases.SHORT.replace(
        processing=cases.SHORT.processing.replace(directions="2d:90", beamformer=beamformer, weighting=weighting)
    )
    settings = settings.replace(accuracy=settings.accuracy.replace(precision=precision, max_error_db=-30.0))
    settings = planner.complete(settings, KERNELS["cpu"], threads=1)
    measurement = cases.noise(settings)
    counts = range(1, KERNELS["cpu"].max_threads + 1)
    images = [Pipeline(settings, threads=count, predict=False).process(measurement).amplitude for count in counts]
    assert len({image.tobytes() for image in images}) == 1
    plain = Pipeline(settings, device="numpy", predict=False).process(measurement).amplitude
    assert np.abs(images[0] - plain).max() < (1e-5 if precision == "float32" else 1e-3) * plain.max()


@pytest.mark.parametrize("device", KERNELS)
@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_beamformers_give_zero_for_zero_input(device, beamformer, weighting):
    settings = cases.CASES["line of 8"]
    settings = settings.replace(
        processing=settings.processing.replace(beamformer=beamformer, weighting=weighting),
        accuracy=settings.accuracy.replace(max_error_db=-35.0),  # the case's -45 is beyond 8 microphones and one tap
    )
    planned = planner.complete(settings, KERNELS[device], threads=1)
    chain = FastChain(planned, KERNELS[device], threads=1)
    out = np.full((len(chain.grid), len(chain.range_m)), 12_345, dtype=np.float32)
    chain.process_signals(np.zeros((8, settings.recording.n_samples)), out)
    assert not out.any()


def cut(points, **options):
    """Levels at 1.2 m versus azimuth: (direction,) in degrees, and in dB relative to the strongest."""
    scene = scene_of(*points, sensor=LINE_16)
    measurement = Simulator(scene, plan=only("spreading", "modulation")).render()
    settings = scene.sensor(None).settings()
    image = Pipeline(settings.replace(processing=settings.processing.replace(**options))).process(measurement)
    ring = image.amplitude[:, np.abs(image.range_m - 1.2) < 0.015].max(axis=1)
    return np.degrees(image.azimuth_rad), 20 * np.log10(ring)


@pytest.mark.parametrize(
    ("options", "lower_db", "lost_db", "narrower"),
    [
        ({"weighting": "coherence_factor"}, 25, 0.2, 0.7),
        ({"beamformer": "dmas"}, 11, 0.1, 0.8),
        ({"beamformer": "dmas", "dmas_order": 5}, 40, 0.2, 0.6),
        ({"beamformer": "dmas", "dmas_order": 5, "weighting": "coherence_factor"}, 60, 0.3, 0.5),
        ({"beamformer": "capon"}, 11, 1.5, 0.3),
    ],
)
def test_adaptive_beamformers_have_lower_side_lobes_and_narrower_beams(options, lower_db, lost_db, narrower):
    point = Point(azimuth_deg=10.0, range_m=1.2, strength_db=-20)
    azimuth_deg, plain_db = cut([point])
    _, found_db = cut([point], **options)
    side = np.abs(azimuth_deg - 10) > 12
    peak_db, plain_peak_db = found_db.max(), plain_db.max()
    assert plain_peak_db - lost_db < peak_db < plain_peak_db + 0.01
    assert found_db[side].max() - peak_db < plain_db[side].max() - plain_peak_db - lower_db
    assert np.sum(found_db > peak_db - 3) < narrower * np.sum(plain_db > plain_peak_db - 3)


def dip_db(azimuth_deg, level_db, first_deg, second_deg):
    """Depth of the level between two directions, below the lower of their two peaks; each is sought within a degree."""
    tops = [level_db[np.abs(azimuth_deg - place) <= 1].max() for place in (first_deg, second_deg)]
    return min(tops) - level_db[(azimuth_deg > first_deg) & (azimuth_deg < second_deg)].min()


def test_capon_separates_two_points_that_delay_and_sum_merges():
    """The points are 8° apart, and beams 7.5° wide. 5 mm in range make their snapshots differ."""
    points = [
        Point(azimuth_deg=side * 4.0, range_m=1.2 + place, strength_db=-20) for side, place in ((-1, 0), (1, 0.005))
    ]
    plain = dip_db(*cut(points), -4.0, 4.0)
    assert dip_db(*cut(points, beamformer="capon", diagonal_loading=0.3), -4.0, 4.0) > plain + 6
    assert dip_db(*cut(points, beamformer="capon"), -4.0, 4.0) > plain + 2


@pytest.mark.parametrize("device", KERNELS)
def test_capon_separates_independent_sources_within_a_beam(device):
    """Narrow band, 16 microphones at half a wavelength: sources 0.6 half-power widths apart, 30 dB above noise."""
    random, sines = np.random.default_rng(6), np.linspace(-0.2, 0.2, 81)
    mics, apart = np.arange(16), 0.6 * 0.886 / 8
    steer = np.exp(1j * np.pi * np.multiply.outer(mics, [-apart / 2, apart / 2]))
    noise_of = [random.standard_normal((2, n, 32)) for n in (2, 16)]
    sources, rest = (part[0] + 1j * part[1] for part in noise_of)
    signals = (steer @ sources + 0.03 * rest).astype(np.complex64)
    weights = (np.exp(-1j * np.pi * np.multiply.outer(sines, mics)) / 16).astype(np.complex64)
    offsets = np.tile(mics.astype(np.int32) * 32, (len(sines), 1))
    power = {}
    for name, options in {"plain": {"diagonal_loading": 1e6}, "capon": {"diagonal_loading": 1e-3}}.items():
        processing = Processing(beamformer="capon", snapshots=32, **options)
        out = np.empty((len(sines), 32), dtype=np.float32)
        AdaptiveBeamform(processing, KERNELS[device], KERNELS[device].memory(), offsets, weights)(
            signals[:, None], (), out
        )
        power[name] = 10 * np.log10((out.astype(float) ** 2).mean(axis=1))
    middle = len(sines) // 2
    assert power["plain"][middle] > power["plain"][np.abs(sines) > apart / 2].max()
    tops = [power["capon"][half].max() for half in (slice(0, middle), slice(middle + 1, None))]
    assert min(tops) > power["capon"][middle] + 6


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (
            {"beamformer": "coherence_factor"},
            r"'coherence_factor' is a weighting; set it as processing\.weighting, with",
        ),
        ({"weighting": "cf"}, r"processing\.weighting 'cf' is unknown; known are none, coherence_factor"),
        ({"beamformer": "mvdr"}, r"processing\.beamformer 'mvdr' is unknown; known are delay_and_sum, .*capon"),
        ({"dmas_order": 1}, r"processing\.dmas_order is 1; use a whole number from 2 to 8"),
        ({"dmas_order": 9}, r"processing\.dmas_order is 9; use a whole number from 2 to 8"),
        ({"snapshots": 0}, r"processing\.snapshots is 0; use a whole number from 1 to 32"),
        ({"snapshots": 33}, r"processing\.snapshots is 33; use a whole number from 1 to 32"),
        ({"diagonal_loading": 0.0}, r"processing\.diagonal_loading is 0; use a number from 1e-06 to 1e\+06"),
        ({"diagonal_loading": math.nan}, r"processing\.diagonal_loading is nan; use a finite number"),
        (
            {"beamformer": "dmas", "method": "paper"},
            r"processing\.method is 'paper', which supports only .*'delay_and_sum' .*; use 'fast' with .*'dmas'",
        ),
        (
            {"beamformer": "capon", "wavefront": "spherical"},
            r"processing\.wavefront is 'spherical', which .*'capon' does not support; use 'plane', or another",
        ),
        (
            {"weighting": "coherence_factor", "method": "paper"},
            r"processing\.method is 'paper', .* 'none'; use 'fast' with processing\.weighting 'coherence_factor'",
        ),
    ],
)
def test_invalid_beamformer_settings_are_refused(options, reported):
    with pytest.raises(ArgumentError, match=reported):
        Processing(**options)


@pytest.mark.parametrize(
    ("case", "order", "many"), [("one microphone", 2, "1 microphone"), ("16 bits, disabled", 5, "4 microphones")]
)
def test_dmas_of_too_few_microphones_is_refused(case, order, many):
    settings = cases.CASES[case]
    settings = settings.replace(processing=settings.processing.replace(beamformer="dmas", dmas_order=order))
    message = rf"dmas_order is {order}, but the array has {many}; .*Use a lower order or another"
    with pytest.raises(ArgumentError, match=message):
        Pipeline(settings)


def test_process_command_selects_a_beamformer(tmp_path):
    recording, target = write_recording(tmp_path / "rec.h5", noise(count=1)), tmp_path / "img.h5"
    done = CliRunner().invoke(
        cli, ["process", str(recording), "-o", str(target), "--beamformer", "capon", "--weighting", "coherence_factor"]
    )
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(target) as images:
        processing = images[0].settings.processing
    assert (processing.beamformer, processing.weighting) == ("capon", "coherence_factor")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--beamformer dmas:order=3", {"dmas_order": 3}),
        ("--beamformer capon:snapshots=7,diagonal_loading=0.5", {"snapshots": 7, "diagonal_loading": 0.5}),
    ],
)
def test_process_command_takes_the_options_of_a_beamformer(tmp_path, options, expected):
    recording, target = write_recording(tmp_path / "rec.h5", noise(count=1)), tmp_path / "img.h5"
    done = CliRunner().invoke(cli, ["process", str(recording), "-o", str(target), *options.split()])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(target) as images:
        processing = images[0].settings.processing
    assert {name: getattr(processing, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("capon:order=3", "'order=3' is not an option of capon; use capon:snapshots=X, diagonal_loading=X"),
        ("delay_and_sum:order=3", "'order=3' is not an option of delay_and_sum; use delay_and_sum alone"),
        ("dmas:order=9", "9 is not in the range 2<=x<=8"),
        ("dmas:order=x", "'x' is not a valid integer"),
        ("dmas:", "'' is not an option of dmas; use dmas:order=X"),
        ("loudest", "'loudest' is not a beamformer; choose one of delay_and_sum, dmas, capon"),
    ],
)
def test_process_command_refuses_options_of_other_beamformers(tmp_path, given, message):
    recording, target = write_recording(tmp_path / "rec.h5", noise(count=1)), tmp_path / "img.h5"
    done = CliRunner().invoke(cli, ["process", str(recording), "-o", str(target), "--beamformer", given])
    assert done.exit_code == 2
    assert message in done.stderr
    assert not target.exists()
