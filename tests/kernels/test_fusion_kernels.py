"""Compiled kernels of fusion against NumPy in double precision."""

import dataclasses
import functools

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba import kernels
from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels import _dispatch, _numpy_fusion
from ertis_numba.kernels._contract.fusion import FusionKernels
from tests.fusion.test_fusion import images, mountings

N_DIRECTIONS, N_STEPS, N_RANGES, N_ENTRIES = 12, 31, 90, 200
N_PIXELS = N_DIRECTIONS * N_STEPS
CELLS = 1, 20, 25
N_CELLS = 500
DOUBLE = "compare_echoes", "find_maxima", "locate_reflector", "match_echoes", "overlap_echoes", "see_places"
COUNTING = "find_arrivals", "match_echoes"  # Their first output holds indices.
NAMES = [field.name for field in dataclasses.fields(FusionKernels)]


def echoes(draws, count=5):
    """Sensors, the echoes of a reflector at (1.1, 0.9, 1.0), some of them from behind, and added variances."""
    sensor_m, ahead = draws.normal(scale=0.2, size=(2 * count, 3)), draws.normal(size=(2 * count, 3))
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    emitter, receiver = np.arange(count), np.arange(count, 2 * count)
    to_m = np.array([1.1, 0.9, 1.0]) - sensor_m
    range_m = np.linalg.norm(to_m, axis=1)
    path_m = range_m[:, None] + range_m
    path_m = path_m[receiver] + np.array([0.0, 0.001, -0.001, 0.0, 0.05])[:, None]  # The last echo is an outlier.
    axes = np.stack([np.linalg.qr(np.column_stack([each, np.eye(3)[:, :2]]))[0].T for each in to_m[receiver]])
    is_behind = np.einsum("ei,ei->e", to_m[receiver], ahead[receiver]) < 0
    assert 0 < is_behind.sum() < count
    mirror = np.eye(3) - 2 * is_behind[:, None, None] * np.einsum("ei,ej->eij", ahead[receiver], ahead[receiver])
    deviation, unused = np.tile([0.002, 0.005], (count, 1)), np.zeros((3, count))
    heard = kernels.HeardEchoes(receiver, path_m, axes @ mirror, deviation, *unused)
    return sensor_m, ahead, heard, np.arange(count), emitter, draws.uniform(0.0, 1e-6, (count, 2))


def matches(draws, n_places=6, n_echoes=60, n_sensors=3):
    """Places, and the echoes of those places with small errors: some are loud, from behind, or of unknown paths."""
    apart_m = draws.uniform(0.5, 3.0, (n_places, n_sensors))
    seen, toward = draws.normal(size=(2, n_places, n_sensors, 3))
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    toward /= np.linalg.norm(toward, axis=2, keepdims=True)
    places = kernels.SeenPlaces(
        apart_m=apart_m,
        toward=toward,
        depth=draws.uniform(-0.3, 1.0, (n_places, n_sensors)),
        seen=seen,
        radiated=np.ones((n_places, n_sensors)),
        gain=draws.uniform(0.5, 1.5, (n_places, n_sensors, n_sensors)),
        beside_m=draws.uniform(0.0, 3e-3, (n_places, n_sensors)),
    )
    across, reflectivity = draws.normal(scale=2e-3, size=(n_places, 3)), draws.uniform(0.9, 1.1, n_places)
    place, receiver = draws.integers(0, n_places, n_echoes), draws.integers(0, n_sensors, n_echoes)
    path_m = apart_m[place] + apart_m[place, receiver, None] + draws.normal(scale=4e-3, size=(n_echoes, n_sensors))
    path_m[draws.random(path_m.shape) < 0.2] = np.nan
    axes, deviation = np.ones((n_echoes, 3, 3)), np.ones((n_echoes, 2))
    axes[:, 0] = seen[place, receiver] + draws.normal(scale=5e-3, size=(n_echoes, 3))
    variances = np.full((2, n_echoes), [[2e-5], [8e-6]])
    heard = kernels.HeardEchoes(receiver, path_m, axes, deviation, *variances, draws.choice([0.2, 1.0, 5.0], n_echoes))
    is_flat = np.array([True, False, True])
    return places, across, reflectivity, 2e-3, is_flat, heard, np.arange(3, n_echoes)


def arrivals(draws, n_sources=15, n_echoes=60, n_sensors=3):
    """Sources around sensors, and echoes of them with small errors: some are from behind, or of unknown paths."""
    sensor_m, ahead = draws.normal(scale=0.1, size=(n_sensors, 3)), draws.normal(size=(n_sensors, 3))
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    origin_m, sent_m = draws.normal(size=(n_sources, n_sensors, 3)), draws.uniform(0.0, 2.0, (n_sources, n_sensors))
    origin_m[3, 1] = np.nan
    receiver, source = draws.integers(0, n_sensors, n_echoes), draws.integers(0, n_sources, n_echoes)
    to_m = origin_m[source, :] - sensor_m[receiver, None]
    path_m = np.linalg.norm(to_m, axis=2) + sent_m[source] + draws.normal(scale=0.01, size=(n_echoes, n_sensors))
    direction = to_m[:, 0] / np.linalg.norm(to_m[:, 0], axis=1)[:, None]
    depth = np.einsum("ei,ei->e", direction, ahead[receiver])
    direction -= 2 * np.minimum(depth, 0.0)[:, None] * ahead[receiver]
    direction += draws.normal(scale=0.03, size=direction.shape)
    is_flat = np.array([True, False, True])
    return origin_m, sent_m, sensor_m, ahead, is_flat, receiver, direction, path_m, 0.02, 0.1


def views(draws, n_places=9, n_sensors=3):
    """Places around sensors, one of them at a sensor; sensors of two kinds of air, and one without an image."""
    sensor_m, ahead = draws.normal(scale=0.1, size=(n_sensors, 3)), draws.normal(size=(n_sensors, 3))
    place_m = np.concatenate([draws.normal(size=(n_places - 1, 3)), sensor_m[1:2]])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    patterns = draws.uniform(0.0, 0.1, (2, n_sensors, 33)) * np.linspace(0.0, 1.0, 33)
    lost = -np.linspace(0.0, 40.0, 129) * draws.uniform(0.5, 2.0, (2, 1))
    beside_m = draws.uniform(0.0, 0.01, (n_sensors, 33))
    is_flat, model = np.array([True, False, True]), np.array([1, -1, 0])
    return place_m, kernels.ViewingSensors(sensor_m, ahead, is_flat, model, patterns, lost, beside_m)


def overlaps(draws, n_reflectors=7, n_echoes=25, n_sensors=3):
    """Echoes of reflectors with small errors, some of them strong, and some of silent emitters."""
    path_m = draws.uniform(1.0, 1.2, (n_reflectors, n_sensors, n_sensors))
    power = draws.choice([1e-3, 1.0, 1e3], path_m.shape)
    direction = draws.normal(size=(n_reflectors, n_sensors, 3)) * [0.2, 1.0, 0.2]
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    receiver, of = draws.integers(0, n_sensors, n_echoes), draws.integers(0, n_reflectors, n_echoes)
    heard_m = path_m[of, receiver] + draws.normal(scale=0.01, size=(n_echoes, n_sensors))
    heard_m[draws.random(heard_m.shape) < 0.2] = np.nan
    is_other = np.arange(n_reflectors)[:, None] != of[:, None, None]
    ahead = draws.normal(size=(n_sensors, 3))
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    widths = draws.uniform(0.01, 0.02, n_sensors), draws.uniform(0.1, 0.3, n_sensors)
    toward, loudness = direction[of, receiver], draws.uniform(0.5, 2.0, n_echoes)
    given = path_m, power, direction, receiver, heard_m, toward, loudness
    return *given, np.repeat(is_other, n_sensors, axis=2), ahead, *widths


@functools.cache
def arguments(seed=3):
    """Arguments of each kernel except the outputs, and the shapes and first values of the outputs."""
    draws = np.random.default_rng(seed)

    def real(*shape):
        return (draws.random(shape) + 0.01).astype(np.float32)

    def places(count, below):
        return draws.permutation(below)[:count].astype(np.uint32)

    def some(*shape, below):
        return draws.integers(0, below, shape).astype(np.uint32)

    near = np.concatenate([np.arange(N_DIRECTIONS)[:, None], some(N_DIRECTIONS, 3, below=N_DIRECTIONS)], axis=1)
    near = near.astype(np.uint32)
    first = np.r_[0, 0, np.sort(draws.permutation(np.arange(1, N_RANGES))[: N_STEPS - 2]), N_RANGES].astype(np.uint32)
    count = draws.integers(0, N_STEPS, N_DIRECTIONS)
    begin, bounds = some(N_DIRECTIONS, below=N_STEPS + 1), np.r_[0, np.cumsum(count)].astype(np.uint32)
    truths = draws.random(N_ENTRIES) < 0.7
    cell, pixel = places(N_ENTRIES, N_CELLS), places(N_ENTRIES, N_PIXELS)
    pixels = some(N_ENTRIES, below=N_PIXELS), some(N_ENTRIES, below=N_PIXELS), real(N_ENTRIES)
    seen = cell, truths, real(N_ENTRIES), real(3, N_ENTRIES)
    predicted = real(4, N_PIXELS)
    image = N_DIRECTIONS, N_STEPS
    half, one = np.float32(0.5), np.float32(1.2)
    bins = np.concatenate([[[0, 1, N_RANGES - 1]], draws.integers(0, N_RANGES, (3, 3))])
    return {
        "coarsen_image": (
            (real(N_DIRECTIONS, N_RANGES), first, draws.random(N_STEPS) < 0.2, near, np.float32(0.3), np.float32(0.2)),
            [(N_STEPS,), image, image],
        ),
        "spread_cells": ((real(*CELLS), 2), [CELLS]),
        "predict_echoes": (
            (begin, bounds, some(bounds[-1], below=N_CELLS), real(bounds[-1]), real(N_CELLS), near),
            [image],
        ),
        "share_echoes": (
            (
                predicted,
                np.array([0, 1, 3], np.uint32),
                np.array([0, 20, 150, N_ENTRIES], np.uint32),
                pixel,
                np.full(N_ENTRIES, 2, np.uint32),
                8 * real(N_PIXELS),
                real(3, N_PIXELS),
                4 * real(N_PIXELS),
                1,
                one,
                half,
            ),
            [(3, N_PIXELS)],
        ),
        "gather_evidence": (
            (*pixels, some(N_ENTRIES, below=N_STEPS), real(N_ENTRIES), real(N_ENTRIES), real(N_PIXELS), real(N_STEPS)),
            [(3, N_ENTRIES)],
        ),
        "add_echoes": (
            (cell, *pixels, real(N_ENTRIES), real(N_ENTRIES), real(N_PIXELS), real(N_PIXELS), True),
            [(2, N_CELLS)],
        ),
        "add_lobes": (
            (real(5, N_DIRECTIONS) * np.float32([[1], [1], [1e-21], [1], [1e-30]]), real(5, N_STEPS)),
            [image],
        ),
        "limit_cells": ((*seen, half), [(N_CELLS,)]),
        "confirm_cells": ((*seen, real(N_CELLS), half, 1), [(3, N_CELLS)]),
        "compare_echoes": ((*seen, real(N_CELLS), half, half), [(2,)]),
        "find_maxima": (
            (real(N_DIRECTIONS, N_RANGES), draws.random((4, N_DIRECTIONS)) < 0.3, bins, 2, 7),
            [(2, 4, 3)],
        ),
        "find_arrivals": (arrivals(draws), [(3, 20)]),
        "see_places": (views(draws), [(9, 3), (9, 3, 3), (9, 3), (9, 3, 3), (9, 3), (9, 3, 3), (9, 3)]),
        "match_echoes": ((*matches(draws), 16.0, 4.0), [(3, 60), (60,)]),
        "overlap_echoes": (overlaps(draws), [(3, 25, 7)]),
        "locate_reflector": ((*echoes(draws), 0.01, 0.05, 2.0, 8), [(3,), (3, 3)]),
    }


def outputs(kernel_set, name, change=lambda values: values, dtype=np.float32):
    """Results of a kernel, with changed arguments of type float32."""
    given, shapes = arguments()[name]
    found = [np.ones(shape, np.float64 if name in DOUBLE else dtype) for shape in shapes]
    if name in COUNTING:
        found[0] = found[0].astype(np.int64)
    out = found if name != "see_places" else [kernels.SeenPlaces(*found)]
    getattr(kernel_set, name)(*map(change, given), *out)
    return found


def doubled(values):
    return values.astype(np.float64) if getattr(values, "dtype", None) == np.float32 else values


@pytest.mark.parametrize("name", NAMES)
def test_fusion_kernels_equal_numpy_in_double_precision(name):
    found = outputs(kernels.load_fusion(), name)
    wanted = outputs(_numpy_fusion.KERNELS, name, doubled, np.float64)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
        assert np.ptp(other) > 0


@pytest.mark.parametrize("load", [kernels.load_fusion, lambda: _numpy_fusion.KERNELS], ids=["compiled", "numpy"])
def test_match_echoes_counts_matches_beyond_its_space(load):
    given, _ = arguments()["match_echoes"]
    found, distance = np.zeros((3, 200), np.int64), np.zeros(200)
    n_all = load().match_echoes(*given, found, distance)
    few, near = np.zeros((3, 5), np.int64), np.zeros(5)
    assert load().match_echoes(*given, few, near) == n_all > 20
    np.testing.assert_array_equal(few, found[:, :5])
    place, echo, emitter = found[:, :n_all]
    assert len({*zip(place, echo, emitter, strict=True)}) == n_all
    assert echo.min() >= 3
    assert np.isfinite(given[5].path_m[echo, emitter]).all()
    assert distance[:n_all].max() < 16.0


@pytest.mark.parametrize("load", [kernels.load_fusion, lambda: _numpy_fusion.KERNELS], ids=["compiled", "numpy"])
def test_find_arrivals_counts_matches_beyond_its_space(load):
    given, _ = arguments()["find_arrivals"]
    found, few = np.zeros((3, 500), np.int64), np.zeros((3, 5), np.int64)
    n_all = load().find_arrivals(*given, found)
    assert load().find_arrivals(*given, few) == n_all > 20
    np.testing.assert_array_equal(few, found[:, :5])
    source, emitter, echo = found[:, :n_all]
    assert not ((source == 3) & (emitter == 1)).any()
    origin_m, sent_m, sensor_m, ahead, is_flat, receiver, _, path_m, within_m, _ = given
    to_m = origin_m[source, emitter] - sensor_m[receiver[echo]]
    late_m = path_m[echo, emitter] - sent_m[source, emitter] - np.linalg.norm(to_m, axis=1)
    assert np.abs(late_m).max() < within_m
    is_behind = np.einsum("mi,mi->m", to_m, ahead[receiver[echo]]) < 0
    assert is_flat[receiver[echo[is_behind]]].all()
    assert is_behind.any()


@pytest.mark.parametrize("name", ["share_echoes", "add_echoes"])
def test_fusion_kernels_accept_unknown_shares_and_confirmations(name):
    place = {"share_echoes": 7, "add_echoes": 7}[name]
    given, shapes = arguments()[name]
    given = (*given[:place], np.empty(0, np.float32), *given[place + 1 :])
    found = []
    for each in (kernels.load_fusion(), _numpy_fusion.KERNELS):
        found.append(np.ones(shapes[0], np.float32))
        getattr(each, name)(*given, found[-1])
    np.testing.assert_allclose(*found, rtol=1e-5, atol=1e-6)


def test_located_reflector_ignores_an_outlier():
    (position_m, _) = outputs(kernels.load_fusion(), "locate_reflector")
    np.testing.assert_allclose(position_m, [1.1, 0.9, 1.0], atol=0.004)


def test_fusion_without_compiled_kernels_gives_the_same_image(monkeypatch):
    def refuse(device="auto"):
        raise DeviceError(f"device {device!r} cannot be set up")

    compiled = ertis.fuse(images().values(), mountings())
    monkeypatch.setattr(_dispatch, "load", refuse)
    kernels.load_fusion.cache_clear()
    try:
        plain = ertis.fuse(images().values(), mountings())
        assert kernels.load_fusion() is _numpy_fusion.KERNELS
    finally:
        kernels.load_fusion.cache_clear()
    highest = plain.image.amplitude.max()
    np.testing.assert_allclose(compiled.image.amplitude, plain.image.amplitude, rtol=1e-4, atol=1e-4 * highest)
    np.testing.assert_allclose(compiled.points.position_m, plain.points.position_m, atol=1e-4)


@pytest.mark.parametrize("load", [kernels.load_fusion, lambda: _numpy_fusion.KERNELS], ids=["compiled", "numpy"])
def test_side_lobes_are_those_of_the_strongest_step_of_a_pulse(load):
    """The steps beside the strongest one have its side lobes; those farther away do not."""
    n_steps, first = 7, np.arange(8, dtype=np.uint32)
    amplitude = np.full((2, n_steps), 0.1, np.float32)
    amplitude[0, 3] = 1.0
    close = np.array([[0], [1]], np.uint32)
    floor, highest, above = np.empty(n_steps, np.float32), *np.empty((2, 2, n_steps), np.float32)
    is_deaf, least = np.zeros(n_steps, np.bool_), np.float32(1e-6)
    load().coarsen_image(amplitude, first, is_deaf, close, np.float32(0.05), least, floor, highest, above)
    wanted = 0.05 * np.array([0.01, 0.01, 1.0, 1.0, 1.0, 0.01, 0.01])
    np.testing.assert_allclose(floor, wanted, rtol=1e-5)
    assert not above[1, 2:5].any()
