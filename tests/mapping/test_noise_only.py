"""Fusion and maps of pulses that carry nothing but noise, or a single weak echo."""

import functools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.noise import echo_floor
from ertis_numba.fusion.rig import Emitters
from ertis_numba.mapping.coverage import heard_m
from ertis_numba.ros.fused_points import FusedImages
from ertis_numba.settings import Recording
from ertis_numba.storage import write_recording
from tests.small_platforms import HEIGHT_M, RATE_HZ, images_of, mounted, rendered, settings_of

POSE = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
FALSE_ALARM = 1e-5
N_SAMPLES, N_MICS = 6400, 32


def filtered(noise, gain):
    return np.fft.irfft(np.fft.rfft(noise, axis=0) * gain(np.fft.rfftfreq(N_SAMPLES, 1 / RATE_HZ))[:, None], axis=0)


def white(random):
    return 1e-3 * random.standard_normal((N_SAMPLES, N_MICS))


TIME_S = np.arange(N_SAMPLES)[:, None] / RATE_HZ


def click(random, places, first=2000):
    """Noise that is loud for 0.5 ms in some microphones."""
    loud = np.zeros((N_SAMPLES, N_MICS))
    loud[first : first + 100, places] = 0.05 * random.standard_normal((100, 1))
    return white(random) + loud


def fading(random):
    """Noise ahead, in all microphones alike, whose level changes with time constants of a millisecond."""
    slow = scipy.signal.lfilter(*scipy.signal.butter(2, 500 / (RATE_HZ / 2)), random.standard_normal(2 * N_SAMPLES))
    level = np.abs(slow[N_SAMPLES:]) / np.std(slow)
    return 0.1 * white(random) + 1e-3 * (random.standard_normal(N_SAMPLES) * level)[:, None]


CHANGING = {
    "a click ahead": lambda random: click(random, slice(None)),
    "a click at the end of the range": lambda random: click(random, slice(None), 4500),
    "a click at the start of the range": lambda random: click(random, slice(None), 300),
    "fading ahead": fading,
    "steps of the supply": lambda random: white(random) + (0.3 * (TIME_S > 0.005) - 0.3 * (TIME_S > 0.0035)),
    "a click in one microphone": lambda random: click(random, slice(7, 8)),
    "20 dB louder towards the end": lambda random: white(random) * (1 + 9 * (TIME_S / TIME_S[-1]) ** 2),
    "modulated at 100 Hz": lambda random: white(random) * (1 + 0.9 * np.sin(2 * np.pi * 100 * TIME_S)),
}
NOISES = CHANGING | {
    "white": white,
    "red": lambda random: filtered(white(random), lambda hz: 3e4 / np.maximum(hz, 500)),
    "a band of 2 kHz": lambda random: filtered(white(random), lambda hz: 10 * ((hz > 38e3) & (hz < 40e3))),
    "a machine ahead": lambda random: white(random) + 1e-3 * random.standard_normal((N_SAMPLES, 1)),
    "steps of int16": lambda random: np.rint(250 * white(random)).astype(np.int16),
    "nothing": lambda random: 0 * white(random),
}


def noise_images(kind, seed, count, directions="90", number=0, **processing):
    """Images of noise of a kind, in each sensor, and their settings."""
    random = np.random.default_rng([seed, number])
    encoding = "int16" if kind == "steps of int16" else "float32"
    settings = settings_of(directions, encoding=encoding, **processing)
    if kind == "PDM":
        settings = settings.replace(
            recording=Recording(n_samples=120_000), processing=settings.processing.replace(range_decimation=12)
        )
        signals = {name: random.integers(0, 2**32, 120_000, np.uint32) for name in mounted(count)}
    else:
        signals = {name: NOISES[kind](random) for name in mounted(count)}
        signals = {name: each if each.dtype == np.int16 else each.astype(np.float32) for name, each in signals.items()}
    return [*images_of(signals, settings, number).values()]


@functools.cache
def fuser(count):
    return ertis.Fuser(mounted(count))


@pytest.mark.parametrize(
    ("kind", "count"), [(kind, 2) for kind in NOISES] + [("PDM", 1), ("white", 1), ("a machine ahead", 1)]
)
def test_noise_is_neither_occupied_nor_free(kind, count):
    mapper = ertis.Mapper(mounted(count))
    for number in range(3):
        images = noise_images(kind, 5, count, number=number)
        fused = fuser(count)(images) if kind != "PDM" else ertis.fuse(images, mounted(count))
        assert len(fused.points) == 0
        assert fused.is_empty
        assert fused.without_echo == fused.sensors
        mapper.add(images, POSE, fused=fused)
    assert mapper.n_empty == mapper.map.n_groups == 3
    assert not mapper.map.is_occupied.any()
    # Only the place of the platform itself is free.
    rows, columns = np.nonzero(mapper.map.is_free)
    free_m = np.array(mapper.map.origin_m) + (np.stack([columns, rows], axis=1) + 0.5) * mapper.map.cell_m
    assert np.hypot(*free_m.T).max() < 0.25


@pytest.mark.parametrize("kind", ["white", "fading ahead", "a click ahead"])
def test_noise_is_neither_occupied_nor_free_in_space(kind):
    mapper = ertis.Mapper(mounted(2), dimensions=3, cell_m=0.1)
    for number in range(2):
        mapper.add(noise_images(kind, 6, 2, "3d:100", number=number), POSE)
    assert not mapper.map.is_occupied.any()
    assert mapper.map.is_free.sum() < 200
    assert mapper.n_empty == 2


def test_commands_say_how_many_pulses_carried_nothing(tmp_path):
    random, settings = np.random.default_rng(4), settings_of()
    measurements = [
        ertis.Measurement(
            white(random).astype(np.float32),
            settings,
            ertis.Stamp(sequence=number, sync_count=number, timestamp_ns=10**18 + number * 10**8, sensor=name),
        )
        for name in mounted(2)
        for number in range(2)
    ]
    write_recording(tmp_path / "noise.h5", measurements, mounting=mounted(2))
    (tmp_path / "still.tum").write_text("999999999.9 0 0 0 0 0 0 1\n1000000000.5 0 0 0 0 0 0 1\n")
    for line in ("map FILE --poses still.tum --json -o map.h5", "fuse FILE --json -o fused.h5"):
        arguments = [
            str(tmp_path / re.sub("FILE", "noise.h5", each)) if "." in each or each == "FILE" else each
            for each in line.split()
        ]
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 0, done.output
        assert json.loads(done.stdout)["empty"] == 2
        assert "note: 2 of 2 pulses carried no echo above the noise" in done.stderr
    with ertis.open_energyscapes(tmp_path / "fused.h5") as images:
        assert all(len(image.points) == 0 for image in images)


@pytest.mark.parametrize(
    "processing",
    [
        {},
        {"beamformer": "dmas"},
        {"beamformer": "dmas", "dmas_order": 3},
        {"beamformer": "capon"},
        {"weighting": "coherence_factor"},
        {"beamformer": "capon", "weighting": "coherence_factor"},
        {"clean_within_db": 6.0},
        {"clean_above_mean_db": 3.0, "weighting": "coherence_factor"},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["a band of 2 kHz", "a machine ahead"])
def test_noise_of_all_beamformers_stays_below_the_floor_of_echoes(processing, kind):
    (image,) = noise_images(kind, 7, 1, **processing)
    floor = echo_floor(image, FALSE_ALARM)
    rows, columns = np.indices(image.amplitude.shape).reshape(2, -1)
    assert (image.amplitude.ravel() < floor.at(image.amplitude, rows, columns, 0.5)).all()


def test_floor_of_echoes_is_that_of_rayleigh_distributed_noise():
    """A bin of noise with root mean square s exceeds t with the probability exp(-t²/s²)."""
    (image,) = noise_images("white", 8, 1)
    random = np.random.default_rng(2)
    amplitude = (0.02 * np.sqrt(random.exponential(size=image.amplitude.shape))).astype(np.float32)
    floor = echo_floor(image.replace(amplitude=amplitude), FALSE_ALARM)
    wanted = 0.02 * math.sqrt(math.log(amplitude.size / FALSE_ALARM))
    for threshold in floor[:2]:
        assert np.median(threshold) == pytest.approx(wanted, rel=0.05)
        assert threshold.max() < 1.2 * wanted


def test_weak_echo_in_noise_is_the_only_obstacle():
    place_m = (2.0, 0.3, HEIGHT_M)
    mapper = ertis.Mapper(mounted())
    for number in range(3):
        signals = rendered(
            mounted(), settings_of(), place_m, -26.0, diameter_m=0.012, random=np.random.default_rng(number), noise=1e-3
        )
        mapper.add(images_of(signals, settings_of(), number).values(), POSE)
    assert mapper.n_empty == 0
    assert len(mapper.map.occupied_m)
    assert np.hypot(*(mapper.map.occupied_m - place_m[:2]).T).max() < 0.15


def test_silence_shows_free_space_as_far_as_a_clear_echo_exceeds_the_noise():
    emitters = Emitters(settings_of(), [0.0])
    loss_db_m = -10 * math.log10(emitters.spreading(np.array(2.0), np.array(2.0)) * 2.0**4) / 2
    for clear, floor in ((1.0, 0.5), (1.0, 0.1), (3.0, 0.2)):
        found_m = heard_m(emitters, clear, floor, 4.0)
        # Beyond the steps of 10 %, the echo is as strong as the floor: clear / r², less the absorption.
        for distance_m, is_heard in ((found_m, True), (found_m / 0.9, False)):
            echo = clear / distance_m**2 * 10 ** (-loss_db_m * 2 * (distance_m - 1) / 20)
            assert (echo > floor) is is_heard or distance_m > 4.0
    assert heard_m(emitters, 0.0, 0.1, 4.0) == 0.0
    assert heard_m(emitters, 1.0, math.inf, 4.0) == 0.0
    assert heard_m(emitters, 1.0, 0.0, 4.0) == 4.0


def test_ros_notes_the_beginning_and_the_end_of_pulses_without_an_echo():
    notes = []
    fused = FusedImages(notes.append)
    echo = images_of(
        rendered(mounted(1), settings_of(), (1.0, 0.0, HEIGHT_M), 0.0, diameter_m=0.0, random=np.random.default_rng(1)),
        settings_of(),
    )["front"]
    (noise,) = noise_images("white", 9, 1)
    for number, image in enumerate([noise, noise, noise, echo, echo]):
        stamp = replace(image.stamp, sync_count=number, timestamp_ns=10**18 + number * 10**8)
        fused.add(image.replace(stamp=stamp), mounted(1))
    assert notes[0] == "SYNC pulse 0 carried no echo above the noise"
    assert notes[1].endswith("has echoes again, after 3 without any above the noise")
    assert len(notes) == 2
