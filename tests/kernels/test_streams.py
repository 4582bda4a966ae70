"""Adaptive beamformers from streams: kernels, tables, errors and plans."""

import itertools

import msgspec
import numpy as np
import pytest

from ertis_numba.chain import stream_recipe
from ertis_numba.kernels import KernelSet
from ertis_numba.pipeline.verification import error_db
from ertis_numba.settings import Processing
from ertis_numba.settings.beamformers import WEIGHTINGS, Weighting
from tests.on_device import KERNELS

STREAMS = {
    # powers, turns, and recipe: number of power sums, order, beam, total, bound
    "delay_and_sum": ([1.0], [1], (1, 1, -1, -1, 1.0)),
    "coherence factor": ([1.0, 2.0], [1, 0], (1, 1, 0, 1, 3e6)),
    "dmas 2": ([0.5, 1.0], [1, 2], (2, 2, -1, -1, 1.0)),
    "dmas 3 without the last power sum": ([1 / 3, 2 / 3], [1, 2], (2, 3, -1, -1, 1.0)),
    "dmas 5 with coherence factor": ([0.2, 0.4, 0.6, 1.0, 2.0], [1, 2, 3, 1, 0], (3, 5, 3, 4, 3e6)),
}
N_MICS, N_PHASES, N_DIRECTIONS, N_PAIRS = 4, 2, 5, 2
LIMIT = 4000.0


@pytest.fixture(params=list(KERNELS))
def kernel_set(request):
    return KERNELS[request.param]


@pytest.fixture(params=[name for name in KERNELS if name != "numpy"])
def compiled(request):
    return KERNELS[request.param]


def noise(*shape, seed=1):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)


def values(signals, power, turns):
    level = np.abs(signals.astype(complex))
    unit = np.divide(signals, level, out=np.zeros(level.shape, complex), where=level > 0)
    return np.where(level > 0, level**power * unit**turns, 0)


def quantised(kernel_set: KernelSet, signals, powers, turns, starts, width, units):
    tiles = np.full((len(starts), len(powers), *signals.shape[:2], width, 2), 99, dtype=np.int16)
    scales = np.full((len(starts), len(powers)), 99, dtype=np.float32)
    limits = np.full(len(powers), LIMIT, dtype=np.float32)
    kernel_set.quantise_streams(
        *(signals, starts, limits, np.array(units, np.float32), np.array(powers, np.float32)),
        *(np.array(turns, np.int32), 0, len(powers), tiles, scales),
    )
    return tiles, scales


@pytest.mark.parametrize("name", STREAMS)
def test_quantised_streams_equal_their_definition(kernel_set, name):
    powers, turns, _ = STREAMS[name]
    signals = noise(N_MICS, N_PHASES, 150)
    signals[1, 1, 20:40] = 0
    starts, width = np.array([0, 96], dtype=np.int32), 100
    tiles, scales = quantised(kernel_set, signals, powers, turns, starts, width, [1.0] * len(powers))
    for tile, start in enumerate(starts):
        part = signals[:, :, start : start + width]
        for stream, (power, count) in enumerate(zip(powers, turns, strict=True)):
            wanted = values(part, power, count)
            if count == 0:  # the imaginary part has the roots
                largest = np.abs(part).max() ** power
                wanted = wanted + 1j * np.sqrt(np.abs(part) ** power * largest)
            found = tiles[tile, stream, :, :, : part.shape[2]] * float(scales[tile, stream])
            step = float(np.abs(part).max()) ** power / LIMIT
            assert scales[tile, stream] == pytest.approx(step, rel=2e-5)
            assert np.abs(found[..., 0] + 1j * found[..., 1] - wanted).max() < 0.76 * step
            assert not tiles[tile, stream, :, :, part.shape[2] :].any()


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e12])
def test_quantised_streams_keep_any_level(kernel_set, scale):
    signals, starts = noise(2, 1, 60), np.zeros(1, dtype=np.int32)
    powers, turns = [1.0, 0.2, 2.0], [1, 1, 0]
    usual, _ = quantised(kernel_set, signals, powers, turns, starts, 64, [1.0] * 3)
    tiles, scales = quantised(kernel_set, np.float32(scale) * signals, powers, turns, starts, 64, [2.0] * 3)
    if scale:
        assert np.abs(tiles.astype(int) - usual).max() <= 1
        largest = scale * float(np.abs(signals).max())
        np.testing.assert_allclose(scales[0], [2 * largest**power / LIMIT for power in powers], rtol=1e-4)
    else:
        assert not tiles.any()
        assert not scales.any()


def tables(name, *, grid):
    """Return random tables of all streams: shapes, offsets, weights, places, tap weights and rows."""
    random = np.random.default_rng(3)
    n_streams = len(STREAMS[name][0])
    n_points = [7 if grid and stream % 2 == 0 else N_DIRECTIONS for stream in range(n_streams)]
    n_pairs = [N_PAIRS if grid and stream % 2 == 0 else 0 for stream in range(n_streams)]
    n_terms = [N_MICS * (1 + stream % 2) for stream in range(n_streams)]
    shapes = np.array(list(zip(n_points, n_terms, n_pairs, strict=True)), dtype=np.int32)
    entries, pairs = int(np.sum(shapes[:, 0] * shapes[:, 1])), N_DIRECTIONS * sum(n_pairs) + 1
    mics = np.concatenate([np.resize(np.arange(N_MICS), points * terms) for points, terms, _ in shapes.tolist()])
    width = 96 + 8
    offsets = (mics * N_PHASES + random.integers(0, N_PHASES, entries)) * width + random.integers(0, 8, entries)
    w = random.integers(-100, 100, (2, entries))
    weights = np.moveaxis(np.array([[w[0], -w[1]], [w[1], w[0]]]), 2, 0).astype(np.int16)
    places, taps = random.integers(0, 6, pairs).astype(np.int32), random.integers(-9000, 9000, (pairs, 2))
    rows = random.permutation(N_DIRECTIONS).astype(np.int32)
    return shapes, offsets.astype(np.int32), np.ascontiguousarray(weights), places, taps.astype(np.int16), rows


@pytest.mark.parametrize("grid", [False, True])
@pytest.mark.parametrize("name", STREAMS)
def test_combined_streams_equal_those_of_numpy(compiled, name, grid):
    powers, turns, recipe = STREAMS[name]
    numpy_set = KERNELS["numpy"]
    starts, width = np.array([0, 96], dtype=np.int32), 104
    signals = noise(N_MICS, N_PHASES, 250)
    units = [1e-7 if grid and stream % 2 == 0 else 1e-3 for stream in range(len(powers))]
    tiles, scales = quantised(numpy_set, signals, powers, turns, starts, width, units)
    table = tables(name, grid=grid)
    found, wanted = np.full((2, N_DIRECTIONS, 130), 12_345, dtype=np.float32)
    assert compiled.tile_ranges == numpy_set.tile_ranges
    for kernels, out in ((compiled, found), (numpy_set, wanted)):
        kernels.combine_streams_int16(tiles, scales, starts, 130, *table, recipe, out)
    assert wanted.max() < 12_345
    assert np.abs(found - wanted).max() < 2e-5 * wanted.max()


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_combined_streams_equal_the_sum_of_all_products(kernel_set, order, weighted):
    """Newton's identities and the coherence factor equal their definitions, with equal weights."""
    signals, starts = noise(N_MICS, 1, 100), np.zeros(1, dtype=np.int32)
    powers, turns = [k / order for k in range(1, order + 1)], list(range(1, order + 1))
    beam, total = (order, order + 1) if weighted else (-1, -1)
    if weighted:
        powers, turns = [*powers, 1.0, 2.0], [*turns, 1, 0]
    units = [1.0] * order + [1 / N_MICS, 1 / N_MICS**2] * weighted
    tiles, scales = quantised(kernel_set, signals, powers, turns, starts, 96, units)
    shapes = np.array([[1, N_MICS, 0]] * len(powers), dtype=np.int32)
    offsets = np.tile(np.arange(N_MICS, dtype=np.int32) * 96, len(powers))
    weights = np.tile(np.eye(2, dtype=np.int16), (len(powers) * N_MICS, 1, 1))
    none = np.zeros(1, dtype=np.int32), np.zeros((1, 2), dtype=np.int16)
    out = np.empty((1, 96), dtype=np.float32)
    recipe = order, order, beam, total, N_MICS**2 * LIMIT
    kernel_set.combine_streams_int16(
        tiles, scales, starts, 96, shapes, offsets, weights, *none, np.zeros(1, dtype=np.int32), recipe, out
    )
    y = signals[:, 0, :96].astype(complex)
    wanted = np.abs(sum(map(np.prod, itertools.combinations(values(y, 1 / order, 1), order), itertools.repeat(0))))
    if weighted:
        wanted *= np.abs(y.sum(axis=0)) ** 2 / (N_MICS * np.sum(np.abs(y) ** 2, axis=0))
    assert error_db(out[0], wanted) < -55


def test_weightings_without_streams_leave_images_to_their_kernel(monkeypatch):
    """A new weighting is not ignored if only its kernel is declared."""
    half = Weighting(title="half", kernel="weight_half")
    monkeypatch.setattr(stream_recipe, "WEIGHTINGS", {**WEIGHTINGS, "half": half})
    for beamformer in ("delay_and_sum", "dmas"):
        processing = Processing(beamformer=beamformer)
        assert stream_recipe.recipe_of(processing) is not None
        msgspec.structs.force_setattr(processing, "weighting", "half")  # The settings accept registered names only.
        assert stream_recipe.recipe_of(processing) is None
