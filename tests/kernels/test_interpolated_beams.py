"""Kernels of interpolated beams equal their references; results are bit-identical for integer inputs."""

import numpy as np
import pytest

from tests import reference
from tests.on_device import KERNELS, SIMULATED, sized

FLOAT32 = 1e-5  # relative to the largest beam
GARBAGE = 12_345.0
SHAPES = {
    # microphones, phases, terms, ranges, nodes, directions, pairs
    "least": (1, 1, 1, 64, 2, 1, 1),
    "one over a tile": (2, 3, 4, 65, 9, 5, 2),
    "one short of two tiles": (2, 3, 2, 191, 9, 7, 2),
    "few directions": (5, 2, 3, 151, 7, 5, 3),
    "prime": (7, 5, 11, 151, 31, 59, 8),
    "line array": (8, 2, 16, 300, 40, 90, 3),
    "eRTIS": (32, 2, 64, 257, 60, 90, 8),
    "six by six": (5, 1, 5, 97, 50, 11, 18),
}
SHAPE_NAMES = sized(
    ["least", "one over a tile", "few directions"],
    ["one short of two tiles", "prime", "line array", "eRTIS", "six by six"],
)
SOME = "few directions" if SIMULATED else "prime"
WINDOWS = sized([(0, 151), (3, 151), (17, 18), (5, 60), (5, 116)], [(0, 64), (40, 104), (130, 151), (150, 151)])
MAX_BLOCKS = 4


@pytest.fixture(params=KERNELS)
def kernel_set(request):
    return KERNELS[request.param]


def some_places(random, n_nodes, n_directions, n_pairs):
    """Random pairs of grid points, including the first and the last."""
    places = random.integers(0, n_nodes - 1, (n_directions, n_pairs)).astype(np.int32)
    places[0, 0], places[-1, -1] = 0, n_nodes - 2
    return places


def some_rows(random, n_directions):
    """Directions in random order."""
    return random.permutation(n_directions).astype(np.int32)


def beam_input(name):
    n_mics, n_phases, n_terms, n_ranges, n_nodes, n_directions, n_pairs = SHAPES[name]
    random = np.random.default_rng(7)
    n_samples = n_ranges + 9
    signals = random.standard_normal((n_mics, n_phases, n_samples, 2)).astype(np.float32).view(np.complex64)[..., 0]
    rows = random.integers(0, n_mics * n_phases, (n_nodes, n_terms))
    offsets = (rows * n_samples + random.integers(0, 10, rows.shape)).astype(np.int32)
    weights = random.standard_normal((n_nodes, n_terms, 2)).astype(np.float32).view(np.complex64)[..., 0]
    taps = random.standard_normal((n_directions, n_pairs, 2)).astype(np.float32)
    places = some_places(random, n_nodes, n_directions, n_pairs)
    return signals, offsets, weights, places, taps, some_rows(random, n_directions)


def image_of(kernel_set, beams, window, n_ranges, n_blocks=1):
    """Output of the kernel for a window, within garbage that it must not change."""
    out = np.full((len(beams[3]), n_ranges), GARBAGE, dtype=np.float32)
    kernel_set.interpolated_beams_envelope(*beams, *window, n_blocks, out)
    return out


@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_interpolated_beams_equal_their_reference(kernel_set, name):
    beams, n_ranges = beam_input(name), SHAPES[name][3]
    expected = np.abs(reference.interpolated_beams(*beams, n_ranges))
    out = image_of(kernel_set, beams, (0, n_ranges), n_ranges)
    assert np.abs(out - expected).max() < FLOAT32 * expected.max()


@pytest.mark.parametrize("window", WINDOWS)
def test_interpolated_beams_fill_only_their_window(kernel_set, window):
    beams, n_ranges = beam_input(SOME), SHAPES[SOME][3]
    expected = np.abs(reference.interpolated_beams(*beams, n_ranges))
    out = image_of(kernel_set, beams, window, n_ranges)
    inside = slice(*window)
    assert np.abs(out[:, inside] - expected[:, inside]).max() < FLOAT32 * expected.max()
    out[:, inside] = GARBAGE
    assert (out == GARBAGE).all()


@pytest.mark.parametrize("name", sized(["least"], ["prime", "six by six"]))
def test_interpolated_beams_are_independent_of_the_number_of_blocks(kernel_set, name):
    beams, n_ranges = beam_input(name), SHAPES[name][3]
    counts = (*range(1, MAX_BLOCKS + 1), SHAPES[name][5] + 3)  # blocks without a direction as well
    images = {image_of(kernel_set, beams, (0, n_ranges), n_ranges, count).tobytes() for count in counts}
    assert len(images) == 1


def test_nan_in_interpolated_beams_affects_only_its_range(kernel_set):
    beams, n_ranges = beam_input(SOME), SHAPES[SOME][3]
    beams[0][3, :, 100] = np.nan
    with np.errstate(invalid="ignore"):  # NumPy also says so
        out = image_of(kernel_set, beams, (0, n_ranges), n_ranges)
    bad = np.flatnonzero(~np.isfinite(out).all(axis=0))
    assert len(bad) > 0
    assert bad.min() >= 100 - 9  # by as many samples as offsets differ
    assert bad.max() <= 100


def whole_input(name, tile_ranges, *, full_scale=False):
    """Input with the largest permitted sums; optionally with all terms of the first grid point at full scale."""
    n_mics, n_phases, n_terms, n_ranges, n_nodes, n_directions, n_pairs = SHAPES[name]
    random = np.random.default_rng(8)
    n_tiles, width = -(-n_ranges // tile_ranges), tile_ranges + 9
    limit = min(2 ** int((31 - 0.5 - np.log2(n_terms)) / 2), 2**15 - 1)
    tiles = random.integers(-limit * 7 // 10, limit * 7 // 10, (n_tiles, n_mics, n_phases, width, 2), np.int16)
    rows = random.integers(0, n_mics * n_phases, (n_nodes, n_terms))
    offsets = (rows * width + random.integers(0, 10, rows.shape)).astype(np.int32)
    real, imag = random.integers(-limit * 7 // 10, limit * 7 // 10, (2, n_nodes, n_terms))
    taps = random.standard_normal((n_directions, n_pairs, 2))
    if full_scale:
        tiles[..., 0], tiles[..., 1] = limit, 0
        real[:], imag[:] = limit, 0
        taps = np.abs(taps)
    taps *= 0.98 * 2**15 / max(np.abs(taps).max(), np.abs(taps).sum(axis=(1, 2)).max() / 2)
    weights = np.stack([np.stack([real, -imag], -1), np.stack([imag, real], -1)], -2).astype(np.int16)
    starts = np.arange(n_tiles, dtype=np.int32) * np.int32(tile_ranges)
    places = some_places(random, n_nodes, n_directions, n_pairs)
    scales = random.random(n_tiles).astype(np.float32)
    rows = some_rows(random, n_directions)
    return (tiles, scales, starts), (offsets, weights, places, taps.astype(np.int16), rows)


def whole_image(kernel_set, tiles, beams, stop, n_ranges, n_blocks=1):
    out = np.full((len(beams[2]), n_ranges), GARBAGE, dtype=np.float32)
    kernel_set.interpolated_beams_envelope_int16(*tiles, stop, *beams, np.float32(0.5), n_blocks, out)
    return out


def expected_levels(tiles, beams, stop, n_ranges):
    """The sums of the reference are exact; its envelope is in single precision, as in the contract."""
    expected = np.full((len(beams[2]), n_ranges), GARBAGE)
    width = tiles[0].shape[3] - 9
    for tile, scale, start in zip(*tiles, strict=True):
        end = min(start + width, stop)
        sums = reference.interpolated_whole_beams(tile, *beams, end - start)
        expected[:, start:end] = 0.5 * scale * np.abs(sums)
    return expected


@pytest.mark.parametrize("full_scale", [False, True])
@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_int16_interpolated_beams_equal_their_reference(kernel_set, name, full_scale):
    n_ranges = SHAPES[name][3]
    tiles, beams = whole_input(name, kernel_set.tile_ranges, full_scale=full_scale)
    out = whole_image(kernel_set, tiles, beams, n_ranges, n_ranges)
    # Only rounding to single precision of exact sums: a sum that is off by one would be seen.
    assert out == pytest.approx(expected_levels(tiles, beams, n_ranges, n_ranges), rel=4e-7)


@pytest.mark.parametrize("stop", [1, 50, 95, 96, 97, 150])
def test_int16_interpolated_beams_fill_only_their_window(kernel_set, stop):
    (tiles, scales, starts), beams = whole_input(SOME, kernel_set.tile_ranges)
    mine = starts < stop
    tiles = (tiles[mine], scales[mine], starts[mine])
    out = whole_image(kernel_set, tiles, beams, stop, 151)
    assert out == pytest.approx(expected_levels(tiles, beams, stop, 151), rel=4e-7)


@pytest.mark.parametrize("name", sized(["least"], ["prime", "six by six"]))
def test_int16_interpolated_beams_are_independent_of_the_number_of_blocks(kernel_set, name):
    n_ranges, counts = SHAPES[name][3], (*range(1, MAX_BLOCKS + 1), SHAPES[name][5] + 3)
    tiles, beams = whole_input(name, kernel_set.tile_ranges)
    images = {whole_image(kernel_set, tiles, beams, n_ranges, n_ranges, count).tobytes() for count in counts}
    assert len(images) == 1


def test_interpolated_beams_are_independent_of_the_number_of_threads():
    cpu = KERNELS["cpu"]
    beams, n_ranges = beam_input("eRTIS"), SHAPES["eRTIS"][3]
    images = set()
    for count in range(1, cpu.max_threads + 1):
        with cpu.threads(count):
            out = image_of(cpu, beams, (0, n_ranges), n_ranges, 2).tobytes()
            tiles, whole = whole_input("eRTIS", cpu.tile_ranges)
            out += whole_image(cpu, tiles, whole, n_ranges, n_ranges, 2).tobytes()
            images.add(out)
    assert len(images) == 1
