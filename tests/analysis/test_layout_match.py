"""Layout match: recordings read with the layout of another array are reported, right ones are not."""

import dataclasses
import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.analysis.health import health, merge
from ertis_numba.analysis.layout_match import LayoutMatch, first_layout_match, layout_match
from ertis_numba.base.errors import LayoutMismatchWarning
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.geometry import layout_names, load_layout
from ertis_numba.geometry.waveform import call_at
from ertis_numba.network.processing._predictions import Predictions
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Processing, Recording, Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_recording

DATA = Path(__file__).parents[2] / "data" / "synthetic"
SETTINGS = Settings(
    recording=Recording(sample_rate_hz=300e3, n_samples=4096, encoding="int16"),
    processing=Processing(directions="2d:9", range_m=(0.5, 1.0), range_decimation=6),
)
SPEED_M_S = 343.2


def heard(positions_m, *, source_m=(0.9, 0.5, 0.1), level=3000, array=None, seed=0):
    """Echo of a point, with spherical wavefronts and noise; ``array`` is that of the settings."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(SETTINGS.recording.n_samples)[:, None] / SETTINGS.recording.sample_rate_hz
    source_m = np.asarray(source_m)
    way_m = np.linalg.norm(source_m) + np.linalg.norm(positions_m - source_m, axis=1)
    words = level * call_at(SETTINGS.call, time_s - way_m / SPEED_M_S) + rng.normal(0, 20, (len(time_s), len(way_m)))
    given = Array(positions_m=positions_m) if array is None else array
    return Measurement(words.astype(np.int16), SETTINGS.replace(array=given), Stamp(sensor="sensor", sequence=seed))


def disc(size_m, count=16):
    turn, radius_m = 2.4 * np.arange(count), size_m / 2 * np.sqrt((np.arange(count) + 1) / count)
    places_m = np.stack([0 * turn, radius_m * np.cos(turn), radius_m * np.sin(turn)], axis=1)
    return places_m - places_m.mean(axis=0)


def read_as(measurement, **array):
    settings = measurement.settings
    return dataclasses.replace(measurement, settings=settings.replace(array=settings.array.replace(**array)))


@pytest.mark.parametrize("recording", ["reflectors.h5", "reflectors_3d.h5"])
@pytest.mark.parametrize("layout", layout_names())
def test_layout_match_finds_the_layout_of_recordings(recording, layout):
    """The loudest sound of the first recording is the direct sound of the emitter, that of the other an echo."""
    with open_recording(DATA / recording) as reader:
        measurement = reader[0]
    settings = measurement.settings.replace(array=Array(layout=layout))
    measurement = dataclasses.replace(measurement, settings=settings)
    match = layout_match(measurement)
    # Processing takes the match of the health report, and compares again only without one.
    assert LayoutMatch.of_report(health(measurement), settings) in {match, None if layout != "eRTIS_v3D1" else match}
    found = match.warning
    assert not found if layout == "eRTIS_v3D1" else "layout eRTIS_v3D1 fits far better" in found


def test_report_without_arrival_or_of_fewer_channels_is_no_match():
    with open_recording(DATA / "reflectors_3d.h5") as reader:
        measurement = reader[0]
    settings, report = measurement.settings, health(measurement)
    assert not LayoutMatch.of_report(report, settings).warning
    silent = np.resize(np.uint32([0x55555555, 0xAAAAAAAA]), measurement.data.shape)
    other = health(dataclasses.replace(measurement, data=silent))
    faulty = dataclasses.replace(report.channels[0], faults=("dead",))
    for doubtful in (other, dataclasses.replace(report, channels=(faulty, *report.channels[1:]))):
        assert LayoutMatch.of_report(doubtful, settings) is None
    assert LayoutMatch.of_report(report, SETTINGS) is None


@pytest.mark.parametrize("size_m", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("source_m", [(0.9, 0.5, 0.1), (1.2, -0.3, 0.4), (0.6, 0.0, 0.0), (1.0, 0.9, 0.0)])
def test_right_positions_match(size_m, source_m):
    assert not layout_match(heard(disc(size_m), source_m=source_m)).warning


@pytest.mark.parametrize(
    ("array", "named"),
    [
        ({"positions_m": disc(0.1)[::-1]}, "the reversed order fits far better"),
        ({"positions_m": disc(0.1)[np.arange(16) ^ 1]}, "the order of swapped neighbours fits far better"),
        ({"positions_m": np.roll(disc(0.1), 8, axis=0)}, "the order of reversed bytes fits far better"),
        ({"positions_m": 10 * disc(0.1)}, "size of the array"),
        ({"positions_m": 0.1 * disc(0.1)}, "size of the array"),
        ({"positions_m": disc(0.1) / 2.54}, "size of the array"),
        ({"delay_s": np.repeat([0.0, 3e-6], 8)}, "channels 8 to 15 are late by -3.0 µs"),
    ],
)
def test_wrong_arrays_are_named(array, named):
    assert named in layout_match(read_as(heard(disc(0.1)), **array)).warning


def test_size_of_direct_sound_is_named():
    """The emitter is at the centre of the array."""
    given = heard(disc(0.1), source_m=(0.0, 0.0, 1e-6))
    assert not layout_match(given).warning
    found = layout_match(read_as(given, positions_m=10 * disc(0.1))).warning
    assert "fits an array 0.1 times as large" in found


def test_silence_and_few_microphones_are_not_judged():
    silent = heard(disc(0.1), level=0)
    assert layout_match(silent) is None
    assert first_layout_match([silent, silent, heard(disc(0.1))]).finding is None
    assert first_layout_match([silent]) is None
    few = disc(0.1, 4)
    assert layout_match(heard(few, array=Array(positions_m=few[::-1]))).finding is None


@pytest.mark.parametrize("count", [8, 10, 11])
@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda places_m: {"positions_m": places_m[::-1]}, "order of channels"),
        (lambda places_m: {"positions_m": 10 * places_m}, "size of the array"),
        (lambda places_m: {"positions_m": places_m / 10}, "size of the array"),
        (lambda places_m: {"positions_m": 2.54 * places_m}, "size of the array"),
        (lambda places_m: {"delay_s": np.where(np.arange(len(places_m)) < len(places_m) // 2, 0, 2e-5)}, "half late"),
    ],
    ids=["reversed", "cm as mm", "mm as cm", "inches", "half late"],
)
def test_arrays_of_few_microphones_are_judged(count, change, fault):
    places_m = disc(0.1, count)
    assert layout_match(read_as(heard(places_m), **change(places_m))).finding.fault == fault


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [5, 6, 8, 11])
def test_arrays_of_few_inexact_microphones_are_not_accused(count, seed):
    """Delays deviate by 3 µs, and two echoes may overlap."""
    rng = np.random.default_rng([count, seed])
    places_m = np.column_stack([np.zeros(count), rng.uniform(-0.1, 0.1, (count, 2))])
    places_m -= places_m.mean(axis=0)
    given, other = (heard(places_m, source_m=(0.9, rng.uniform(-0.5, 0.5), 0.1), seed=seed) for _ in range(2))
    both = dataclasses.replace(given, data=(given.data + other.data * rng.integers(0, 2)).astype(np.int16))
    assert not layout_match(read_as(both, delay_s=rng.normal(0, 3e-6, count))).warning


def grid(count=4, pitch_m=0.006):
    across_m = (np.arange(count) - (count - 1) / 2) * pitch_m
    y_m, z_m = np.meshgrid(across_m, across_m[::-1])
    return np.stack([0 * y_m.ravel(), y_m.ravel(), z_m.ravel()], axis=1)


def snake(count=4):
    order = np.arange(count**2).reshape(count, count)
    order[1::2] = order[1::2, ::-1]
    return order.ravel()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [12, 16, 32])
def test_any_wrong_order_of_channels_is_named(count, seed):
    order = np.random.default_rng([count, seed]).permutation(count)
    found = layout_match(read_as(heard(disc(0.08, count)), positions_m=disc(0.08, count)[order])).finding
    assert found.fault in ("misfit of the array", "order of channels")
    assert len(found.channels) == count
    assert found.measured > found.limit


def test_order_that_only_echoes_show_is_named():
    """The direct sound of an emitter in the middle arrives at both ends of a row of microphones at once."""
    echo, call = heard(grid()), SETTINGS.call
    time_s = np.arange(SETTINGS.recording.n_samples)[:, None] / SETTINGS.recording.sample_rate_hz
    direct = 15000 * call_at(call, time_s - np.linalg.norm(grid(), axis=1) / SPEED_M_S)
    both = dataclasses.replace(echo, data=(echo.data + direct).astype(np.int16))
    assert not layout_match(both).warning
    assert layout_match(read_as(both, positions_m=grid()[snake()])).finding.fault == "misfit of the array"


@pytest.mark.parametrize("inverted", [range(8, 16), range(1, 16, 2), range(5), range(10)])
def test_opposite_signs_of_many_channels_are_named(inverted):
    echo = heard(disc(0.08))
    words = echo.data.copy()
    words[:, list(inverted)] *= -1
    found = layout_match(dataclasses.replace(echo, data=words)).finding
    few, others = sorted([set(inverted), set(range(16)) - set(inverted)], key=len)
    assert found.fault == "opposite signs"
    assert set(found.channels) in ((few,) if len(few) < len(others) else (few, others))
    assert found.measured > found.limit


@pytest.mark.parametrize("n_echoes", [1, 2, 4])
def test_right_arrays_are_not_accused_by_close_echoes(n_echoes):
    rng = np.random.default_rng(n_echoes)
    for seed in range(25):
        places_m = (disc(rng.uniform(0.02, 0.1), int(rng.choice([8, 16, 32]))), grid())[seed % 2]
        echoes = [
            heard(places_m, source_m=rng.uniform([0.6, -0.6, -0.4], [1.3, 0.6, 0.4]), level=rng.uniform(800, 3000))
            for _ in range(n_echoes)
        ]
        words = sum(each.data for each in echoes).astype(np.int16)
        assert not layout_match(dataclasses.replace(echoes[0], data=words)).warning, seed


@pytest.mark.parametrize("factor", [10, 0.1, 1 / 2.54])
def test_scaled_layouts_are_named_by_their_unit(factor):
    array = load_layout("eRTIS_v3D1")
    found = layout_match(heard(array.positions_m, array=Array(positions_m=factor * array.positions_m))).finding
    assert found.fault == "size of the array"
    assert found.detail == f"the positions are those of layout eRTIS_v3D1 times {factor:.3g}"


@pytest.mark.parametrize(
    ("count", "named"),
    [
        (16, "scale of the positions: an echo fits arrays of about half to twice the size equally well"),
        (7, "scale of the positions: 7 microphones are too few to detect even a wrong unit"),
        (5, "scale of the positions, mirrored or turned positions, shift of the record: 5 microphones are too"),
    ],
)
def test_health_states_what_no_echo_reveals(count, named):
    report = health(heard(disc(0.1, count)))
    found = [str(each) for each in report.not_observable]
    assert any("mirrored or turned positions" in each for each in found)
    assert any(named in each for each in found)
    assert report.verdict().startswith("no fault found; not observable: ")
    assert all(fault in report.verdict() for each in report.not_observable for fault in each.faults)


def wrong_orders(places_m):
    """Yield arrays that a recording of these positions may be read as, and the property that is then wrong."""
    for place in (1, 3):
        yield "order", np.roll(places_m, place, axis=0)
    yield "order", places_m[::-1]
    swapped = places_m.copy()
    swapped[[0, 2]] = swapped[[2, 0]]
    yield "order", swapped
    for factor in (0.8, 1.2, 1.25):
        yield "scale", factor * places_m


def ring(size_m, count):
    turn = 2 * np.pi * np.arange(count) / count
    return size_m / 2 * np.stack([0 * turn, np.cos(turn), np.sin(turn)], axis=1)


def line(size_m, count):
    return np.linspace([0, -size_m / 2, 0], [0, size_m / 2, 0], count)


@pytest.mark.parametrize("count", [4, 6, 7, 9, 12])
@pytest.mark.parametrize("shape", [disc, ring, line])
def test_wrong_orders_and_scales_of_few_microphones_are_named_or_not_observable(shape, count):
    for seed, (wrong_property, positions_m) in enumerate(wrong_orders(shape(0.08, count))):
        given = heard(shape(0.08, count), array=Array(positions_m=positions_m), seed=seed, source_m=(0.9, 0.3, 0.2))
        report = health(given)
        named = [fault for each in report.not_observable for fault in each.faults]
        assert report.findings or any(wrong_property in fault for fault in named), (positions_m, named)


@pytest.mark.parametrize("count", [4, 6, 7, 9, 12, 16])
@pytest.mark.parametrize("shape", [disc, ring, line])
def test_right_orders_of_few_microphones_are_not_accused(shape, count):
    for seed, size_m in enumerate((0.03, 0.08, 0.2)):
        assert not health(heard(shape(size_m, count), seed=seed, source_m=(0.8, 0.3 * seed - 0.3, 0.1))).findings


@pytest.mark.parametrize(
    "call",
    [
        {"start_frequency_hz": 25e3, "stop_frequency_hz": 50e3},
        {"modulation": "linear"},
        {"duration_s": 1e-3},
        {"start_frequency_hz": 41.5e3, "stop_frequency_hz": 20.75e3, "duration_s": 3e-3},
    ],
    ids=str,
)
@pytest.mark.parametrize("count", [8, 12, 16])
def test_health_accuses_no_channels_of_another_call(call, count):
    for seed in range(3):
        given = heard(disc(0.2, count), seed=seed, source_m=(0.8, 0.2 * seed, 0.1))
        report = health(
            dataclasses.replace(given, settings=given.settings.replace(call=given.settings.call.replace(**call)))
        )
        assert not report.findings


def test_rotated_and_swapped_orders_are_named():
    places_m = disc(0.2, 12)
    swapped = places_m[[0, 5, 2, 3, 4, 1, *range(6, 12)]]
    for positions_m, name in ((np.roll(places_m, 2, axis=0), "rotated by 10"), (swapped, "channels 1 and 5 swapped")):
        found = layout_match(heard(places_m, array=Array(positions_m=positions_m)))
        assert name in found.warning


def test_large_arrays_are_judged_by_some_microphones():
    many = disc(0.3, 120)
    assert layout_match(heard(many)).finding is None
    assert "reversed order" in layout_match(heard(many, array=Array(positions_m=many[::-1]))).warning


def wrong():
    """Two measurements, of which the first is silent, with another layout of the same number of microphones."""
    array, other = load_layout("eRTIS_v3D1"), Array(layout="eRTIS_v2")
    return [heard(array.positions_m, level=level, array=other, seed=seed) for seed, level in enumerate((0, 3000))]


def test_pipelines_warn_once_of_another_layout():
    silent, loud = wrong()
    with Pipeline(loud.settings, "cpu", 1) as pipeline:
        pipeline.process(silent)
        with pytest.warns(LayoutMismatchWarning, match="layout eRTIS_v3D1 fits far better") as caught:
            pipeline.process(loud)
        pipeline.process(loud)
        assert [each.filename for each in caught] == [__file__]
    with Pipeline(loud.settings, "cpu", 1, predict=False) as pipeline, warnings.catch_warnings():
        warnings.simplefilter("error")
        pipeline.process(loud)


def test_process_warns_of_another_layout_on_stderr_and_in_the_file(tmp_path):
    recording, images = write_recording(tmp_path / "rec.h5", wrong()), tmp_path / "rec.energy.h5"
    done = CliRunner().invoke(cli, ["process", str(recording), "--json"])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(images) as opened:
        assert "layout eRTIS_v3D1 fits far better" in opened.layout_warning
        assert f"ertis: warning: {recording}: sensor sensor: {opened.layout_warning}" in done.stderr.splitlines()
        assert opened.layout_warning == json.loads(done.stdout)["sensors"][0]["layout_warning"]
    assert "layout eRTIS_v3D1 fits far better" in CliRunner().invoke(cli, ["info", str(images)]).stdout
    strict = CliRunner().invoke(cli, ["process", str(recording), "--strict", "--force"])
    assert strict.exit_code == 1
    assert "layout eRTIS_v3D1 fits far better" in strict.stderr


@pytest.mark.parametrize("command", ["process", "acoustic"])
def test_processing_with_the_settings_of_another_array_warns(tmp_path, command):
    shutil.copy(DATA / "reflectors_3d.h5", tmp_path / "rec.h5")
    (tmp_path / "other.toml").write_text('array.layout = "eRTIS_v2"\nprocessing.directions = "2d:9"\n')
    files = [str(tmp_path / "rec.h5"), "--settings", str(tmp_path / "other.toml")]
    done = CliRunner().invoke(cli, [command, *files])
    assert done.exit_code == 0, done.stderr
    assert "layout eRTIS_v3D1 fits far better" in done.stderr


def test_workers_report_another_layout():
    _, loud = wrong()
    predictions = Predictions("cpu")
    predictions._report_sound(  # noqa: SLF001  the thread needs an image
        "left", loud
    )
    (found,) = predictions.drain()
    assert (found.sensor, found.event) == ("left", "layout_mismatch")
    assert "layout eRTIS_v3D1 fits far better" in found.warning


def beside(seed, *, is_swapped):
    """An array beside a loud emitter, with echoes; two neighbouring channels may be swapped."""
    rng = np.random.default_rng([7, seed])
    count = int(rng.integers(4, 33))
    places_m = (disc, ring, line)[seed % 3](rng.uniform(0.04, 0.25), count)
    turn = rng.uniform(0, 2 * np.pi)
    emitter_m = rng.uniform(0.05, 0.15) * np.array([0.1, np.cos(turn), np.sin(turn)])
    direct_m = np.linalg.norm(places_m - emitter_m, axis=1)
    ways = [(direct_m, 0.02 / np.maximum(direct_m, 0.02))]
    for _ in range(rng.integers(0, 5)):
        source_m = rng.uniform((0.4, -0.8, -0.3), (1.2, 0.8, 0.3))
        way_m = np.linalg.norm(source_m - emitter_m) + np.linalg.norm(places_m - source_m, axis=1)
        ways.append((way_m, rng.uniform(0.005, 0.1)))
    time_s = np.arange(SETTINGS.recording.n_samples)[:, None] / SETTINGS.recording.sample_rate_hz
    words = rng.normal(0, 10, (len(time_s), count))
    for way_m, amplitude in ways:
        words += 25e3 * amplitude * call_at(SETTINGS.call, time_s - way_m / SPEED_M_S)
    one = int(rng.integers(0, count))
    other = int(np.argsort(np.linalg.norm(places_m - places_m[one], axis=1))[1])
    if is_swapped:
        places_m[[one, other]] = places_m[[other, one]]
    settings = SETTINGS.replace(array=Array(positions_m=places_m))
    return Measurement(np.clip(words, -32e3, 32e3).astype(np.int16), settings, Stamp(sensor="sensor", sequence=0))


@pytest.mark.parametrize("seed", range(15))
def test_right_arrays_beside_a_loud_emitter_are_not_accused(seed):
    assert not health(beside(seed, is_swapped=False)).findings


@pytest.mark.parametrize("seed", range(15))
def test_swapped_channels_beside_a_loud_emitter_are_named_or_not_observable(seed):
    report = health(beside(seed, is_swapped=True))
    assert report.findings or any("order of channels" in each.faults for each in report.not_observable)


def test_moving_reflector_shows_the_order_of_channels():
    turns = np.linspace(0, 5, 3)
    places_m = disc(0.2, 32)
    reports = [health(heard(places_m, source_m=(0.8, 0.6 * np.cos(turn), 0.5 * np.sin(turn)))) for turn in turns]
    assert any("order of channels" in each.faults for each in reports[0].not_observable)
    assert not any("order of channels" in each.faults for each in merge(reports).not_observable)
