"""Every kernel of every device against its float64 reference, over one table of cases."""

import inspect
import itertools
from pathlib import Path

import numpy as np
import pytest
from ertis_bench.error_trials import reference_image

from ertis_numba import kernels
from ertis_numba.kernels._kernel_set import CONTRACTS
from ertis_numba.pipeline import Pipeline
from tests import cases, reference
from tests.on_device import KERNELS, SIMULATED, sized

FLOAT32 = 1e-5  # relative to the largest input

WORDS = {
    # dtype, samples, words per sample, channels
    "eRTIS": (np.uint32, 4096, 1, range(32)),
    "one microphone": (np.uint8, 1000, 1, [0]),
    "bytes, disabled channels": (np.uint8, 997, 2, [1, 3, 9, 15]),
    "16 bits": (np.uint16, 1024, 1, range(7)),
    "64 bits, more than a warp": (np.uint64, 140, 2, range(30, 68)),
    "64 bits, all": (np.uint64, 511, 2, range(128)),
    "one sample": (np.uint32, 1, 1, range(32)),
}
WORD_NAMES = sized(
    ["bytes, disabled channels", "64 bits, more than a warp", "one sample"],
    ["eRTIS", "one microphone", "16 bits", "64 bits, all"],
)
SHAPES = {
    # microphones, phases, samples, ranges, directions
    "one of each": (1, 1, 1, 1, 1),
    "less than a tile": (3, 2, 50, 20, 7),
    "one short of a tile": (2, 3, 80, 63, 5),
    "a tile": (2, 3, 80, 64, 5),
    "one over a tile": (2, 3, 80, 65, 5),
    "one short of two tiles": (2, 3, 140, 127, 2),
    "two tiles": (2, 3, 140, 128, 5),
    "small prime": (5, 3, 211, 131, 7),
    "prime": (7, 5, 211, 151, 293),
    "eRTIS": (32, 10, 400, 300, 90),
    "many microphones": (257, 2, 100, 70, 3),
}
SHAPE_NAMES = sized(
    ["one of each", "less than a tile", "one short of two tiles", "two tiles", "small prime"],
    ["one short of a tile", "a tile", "one over a tile", "prime", "eRTIS", "many microphones"],
)
DECIMATIONS = sized(
    # factor, first, n_outputs, outputs
    [(10, -3, 40, 40), (1, 3, 1, 1), (7, 10, 20, 24), (10, 5, 0, 9)],
    [(10, 0, 100, 130), (10, 7, 33, 32 + 33), (7, 90, 60, 64)],
)


@pytest.fixture(params=KERNELS)
def kernel_set(request):
    return KERNELS[request.param]


def words_of(name):
    dtype, n_samples, n_words, channels = WORDS[name]
    words = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (n_samples, n_words), dtype=dtype, endpoint=True)
    return words, np.array(channels, dtype=np.int32)


def complex_noise(*shape, seed=1):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)


def real_noise(*shape, seed=1):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def filled(*shape, dtype=np.float32):
    """Return an output array full of garbage, because a kernel must write every element."""
    return np.full(shape, 12_345, dtype=dtype)


def taps_of(count):
    taps = np.hanning(count + 2)[1:-1]
    return (taps / taps.sum()).astype(np.float32)


def beam_input(name):
    n_mics, n_phases, n_samples, n_ranges, n_directions = SHAPES[name]
    random = np.random.default_rng(2)
    row = np.arange(n_mics) * n_phases + random.integers(0, n_phases, (n_directions, n_mics))
    offsets = row * n_samples + random.integers(0, n_samples - n_ranges + 1, (n_directions, n_mics))
    weights = complex_noise(n_directions, n_mics, seed=3)
    return complex_noise(n_mics, n_phases, n_samples), offsets.astype(np.int32), weights, (n_directions, n_ranges)


@pytest.mark.parametrize("device", KERNELS)
@pytest.mark.parametrize("name", CONTRACTS)
def test_kernel_signatures_match_their_contracts(device, name):
    kernel = getattr(kernels.load(device), name)
    kernel = getattr(kernel, "py_func", kernel)
    wanted = list(inspect.signature(CONTRACTS[name].__call__).parameters)[1:]
    assert list(inspect.signature(kernel).parameters) == wanted
    assert kernel.__name__ == name


def test_kernels_with_twins_have_contracts():
    folder = Path(kernels.__file__).parent
    cpu, cuda = ({path.stem for path in (folder / name).glob("*.py")} for name in ("_cpu", "_cuda"))
    assert set(CONTRACTS) == (cpu & cuda) - {"__init__"}


@pytest.mark.parametrize("array", [np.ones((3, 2)).T, np.ones((3, 4))[:, ::2], np.ones((1, 5)).T, np.float32(3.0)])
def test_tables_are_in_one_order_for_which_kernels_are_compiled(array):
    table = kernels.load("cpu").memory().table(np.asarray(array))
    assert table.flags.c_contiguous
    assert table.shape == np.shape(array)
    assert (table == array).all()


@pytest.mark.parametrize("name", WORD_NAMES)
def test_unpack_bits_equals_its_reference(kernel_set, name):
    words, channels = words_of(name)
    out = filled(len(channels), len(words))
    kernel_set.unpack_bits(words, channels, out)
    assert (out == reference_image.unpack_bits(words, channels)).all()


@pytest.mark.parametrize("first", [0, 3, -5, 200, -300])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_unpack_pcm_equals_its_reference(kernel_set, dtype, first):
    random = np.random.default_rng(4)
    words = (20_000 * random.standard_normal((150, 5))).clip(-32_768, 32_767).astype(dtype)
    words[10], words[11] = 1, -2
    channels, scale = np.array([0, 2, 4], dtype=np.int32), np.float32(2.0**-15)
    out = filled(3, 180)
    kernel_set.unpack_pcm(words, channels, scale, np.float32(1.5), first, out)
    padded = np.zeros((700, 3))
    padded[300:450] = words[:, channels] / 2.0**15
    padded[np.abs(padded) < 1.5 * 2.0**-15] = 0
    assert (out == padded[300 + first :][:180].T).all()


@pytest.mark.parametrize(
    ("shape", "n_taps", "factor"),
    sized([((1, 1), 1, 1), ((2, 50), 61, 7), ((1, 20), 1, 10), ((2, 999), 61, 5)], [((32, 4096), 512, 10)]),
)
def test_decimate_equals_its_reference(kernel_set, shape, n_taps, factor):
    signals, taps = real_noise(*shape), taps_of(n_taps)
    out = filled(shape[0], -(-shape[1] // factor))
    kernel_set.decimate(signals, taps, factor, out)
    assert out == pytest.approx(reference.decimate(signals, taps, factor), abs=FLOAT32)


@pytest.mark.parametrize(
    ("n_samples", "delay", "n_out"), [(10, 0, 10), (10, 3, 10), (10, 3, 5), (10, 20, 4), (1, 0, 1)]
)
def test_remove_group_delay_equals_its_reference(kernel_set, n_samples, delay, n_out):
    signals, out = real_noise(3, n_samples), filled(3, n_out)
    kernel_set.remove_group_delay(signals, delay, out)
    expected = np.concatenate([signals, np.zeros((3, delay + n_out))], axis=1)[:, delay : delay + n_out]
    assert (out == expected).all()


@pytest.mark.parametrize("taps_type", [np.int16, np.int32])
@pytest.mark.parametrize("name", WORD_NAMES)
@pytest.mark.parametrize(("factor", "first", "n_outputs", "n_out"), DECIMATIONS)
def test_demodulate_words_equals_its_three_parts(kernel_set, name, factor, first, n_outputs, n_out, taps_type):
    words, channels = words_of(name)
    taps = np.rint(0.98 * np.iinfo(taps_type).max * taps_of(61).astype(float)).astype(taps_type)
    out = filled(len(channels), n_out)
    kernel_set.demodulate_words(words, channels, taps, np.float32(0.25), factor, first, n_outputs, out)
    signals = reference_image.unpack_bits(words, channels)
    filtered = np.stack([np.convolve(signal, taps.astype(float)) for signal in signals])
    places = (first + np.arange(n_outputs)) * factor + len(taps) // 2
    inside = (places >= 0) & (places < filtered.shape[1])
    expected = np.zeros((len(channels), n_out))
    expected[:, :n_outputs][:, inside] = 0.25 * np.rint(filtered[:, places[inside]])
    assert (out == expected.astype(np.float32)).all()  # sums of integers must be exact


@pytest.mark.parametrize("word", [0, 0xFFFF_FFFF])
@pytest.mark.parametrize("taps_type", [np.int16, np.int32])
def test_demodulate_words_handles_taps_at_the_limit(kernel_set, word, taps_type):
    limit = np.iinfo(taps_type).max
    taps = np.array([-1_000, 3_000, limit - 8_000, 3_000, -1_000], dtype=taps_type)
    out = filled(32, 64)
    words = np.full((128, 1), word, dtype=np.uint32)
    kernel_set.demodulate_words(words, np.arange(32, dtype=np.int32), taps, np.float32(1), 1, 10, 64, out)
    assert (out == np.float32((limit - 4_000) * (1 if word else -1))).all()


@pytest.mark.parametrize("shape", sized([(1, 1), (3, 17), (2, 131)], [(32, 1009)]))
def test_multiply_spectra_equals_its_reference(kernel_set, shape):
    spectra, response = complex_noise(*shape), complex_noise(shape[1], seed=2)
    for n in (shape[1], 2 * shape[1] + 1):
        out = filled(shape[0], n, dtype=np.complex64)
        kernel_set.multiply_spectra(spectra, response, out)
        assert np.abs(out[:, : shape[1]] - spectra.astype(complex) * response).max() < 10 * FLOAT32
        assert not out[:, shape[1] :].any()


@pytest.mark.parametrize("own_responses", [False, True])
@pytest.mark.parametrize(
    ("n_bins", "first_bin", "n_band", "n_phases", "n_out"),
    sized(
        [(1, 0, 1, 1, 1), (100, 10, 30, 3, 64), (100, 50, 50, 2, 64), (100, 5, 90, 4, 16), (300, 160, 140, 1, 133)],
        [(700, 600, 97, 10, 134)],
    ),
)
def test_multiply_and_fold_equals_its_reference(kernel_set, n_bins, first_bin, n_band, n_phases, n_out, own_responses):
    spectra, responses = complex_noise(3, n_bins), complex_noise(3 if own_responses else 1, n_phases, n_band, seed=2)
    out = filled(3, n_phases, n_out, dtype=np.complex64)
    kernel_set.multiply_and_fold(spectra, responses, first_bin, out)
    expected = np.zeros((3, n_phases, n_out), dtype=complex)
    for b in range(n_band):
        expected[:, :, (first_bin + b) % n_out] += spectra[:, first_bin + b, None].astype(complex) * responses[:, :, b]
    assert np.abs(out - expected).max() < 10 * FLOAT32


@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_delay_and_sum_and_envelope_equal_their_references(kernel_set, name):
    signals, offsets, weights, shape = beam_input(name)
    expected = reference.delay_and_sum(signals, offsets, weights, shape[1])
    beams, amplitude, fused = filled(*shape, dtype=np.complex64), filled(*shape), filled(*shape)
    kernel_set.delay_and_sum(signals, offsets, weights, beams)
    kernel_set.envelope(beams, 1, amplitude)
    kernel_set.delay_and_sum_envelope(signals, offsets, weights, 0, shape[1], fused)
    bound = FLOAT32 * np.abs(expected).max()
    assert np.abs(beams - expected).max() < bound
    assert np.abs(amplitude - np.abs(expected)).max() < bound
    for step in (2, 7):
        fewer = filled(shape[0], -(-shape[1] // step))
        kernel_set.envelope(beams, step, fewer)
        assert fewer.tobytes() == amplitude[:, ::step].tobytes()
    assert np.abs(fused - np.abs(expected)).max() < bound


@pytest.mark.parametrize("shape", sized([(1, 1, 1), (3, 2, 50), (5, 7, 131)], [(32, 10, 300)]))
def test_quantise_tiles_equals_its_reference(kernel_set, shape):
    signals = complex_noise(*shape)
    starts = np.array([0, shape[2] // 3, shape[2] - 1], dtype=np.int32)
    signals[:, :, : starts[1]] *= 1e-4  # the first tile is far weaker than the others
    width, limit = max(1, shape[2] // 3), np.float32(11_000)
    tiles, scales = filled(3, *shape[:2], width, 2, dtype=np.int16), filled(3)
    kernel_set.quantise_tiles(signals, starts, limit, tiles, scales)
    for tile, start in enumerate(starts):
        part = signals[:, :, start : start + width]
        largest = np.abs(part).max()
        assert scales[tile] == pytest.approx(largest / limit)
        back = (tiles[tile, ..., 0] + 1j * tiles[tile, ..., 1])[:, :, : part.shape[2]] * scales[tile]
        assert np.abs(back - part).max() < 0.75 * largest / limit
        assert not tiles[tile, :, :, part.shape[2] :].any()


def test_quantise_tiles_of_silence_gives_zeros(kernel_set):
    tiles, scales = filled(1, 2, 3, 10, 2, dtype=np.int16), filled(1)
    kernel_set.quantise_tiles(np.zeros((2, 3, 10), np.complex64), np.zeros(1, np.int32), np.float32(100), tiles, scales)
    assert not tiles.any()
    assert not scales.any()


@pytest.mark.parametrize("n_ranges", [1, 95, 96, 97, 300])
@pytest.mark.parametrize("n_mics", sized([1, 32], [1000]))
def test_delay_and_sum_envelope_int16_equals_its_reference(kernel_set, n_ranges, n_mics):
    tile_ranges = kernel_set.tile_ranges
    random = np.random.default_rng(1)
    n_tiles = -(-n_ranges // tile_ranges)
    starts = np.arange(n_tiles, dtype=np.int32) * np.int32(tile_ranges)
    # All microphones at full scale and in phase give the largest possible sums.
    limit, largest = 2 ** int((31 - 0.5 - np.log2(n_mics)) / 2), 2 ** int((31 - 0.5 - np.log2(n_mics)) / 2)
    limit, largest = min(limit, 32_767), min(largest, 32_767)
    tiles = random.integers(-limit, limit, (n_tiles, n_mics, 2, tile_ranges + 4, 2), np.int16, endpoint=True)
    tiles[0, :, :, 0] = limit
    offsets = (np.arange(n_mics) * 2 + random.integers(0, 2, (5, n_mics))) * (tile_ranges + 4)
    offsets = (offsets + random.integers(0, 4, offsets.shape)).astype(np.int32)
    real, imag = random.integers(-largest // 2, largest // 2, (2, 5, n_mics))
    real[0], imag[0] = largest * 7 // 10, largest * 7 // 10
    weights = np.stack([np.stack([real, -imag], -1), np.stack([imag, real], -1)], -2).astype(np.int16)
    scales, out = random.random(n_tiles).astype(np.float32), filled(5, n_ranges)
    kernel_set.delay_and_sum_envelope_int16(tiles, scales, starts, n_ranges, offsets, weights, np.float32(0.5), out)
    for tile, start in enumerate(starts):
        flat = tiles[tile].reshape(-1, 2).astype(float) @ [1, 1j]
        stop = min(start + tile_ranges, n_ranges)
        beams = reference.delay_and_sum(flat, offsets, real + 1j * imag, stop - start)
        expected = 0.5 * scales[tile] * np.abs(beams)
        assert out[:, start:stop] == pytest.approx(expected, rel=1e-6, abs=1e-6 * expected.max())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_infinity_affect_only_their_own_outputs(kernel_set, value):
    """Fast-math flags, which assume that there are no NaN and infinities, must not be used for any kernel."""
    signals, offsets, weights, shape = beam_input("small prime" if SIMULATED else "prime")
    signals[3, :, 100] = value
    out = filled(*shape)
    with np.errstate(invalid="ignore"):  # the NumPy reference warns about invalid values
        kernel_set.delay_and_sum_envelope(signals, offsets, weights, 0, shape[1], out)
    touched = offsets[:, 3] % signals.shape[2]
    for direction in range(shape[0]):
        place = 100 - touched[direction]
        bad = np.flatnonzero(~np.isfinite(out[direction]))
        assert bad.tolist() == ([place] if 0 <= place < shape[1] else [])


@pytest.mark.parametrize("precision", ["float32", "int16"])
def test_pipeline_gives_the_same_bits_every_time(precision):
    """The last tile of ranges is only partly filled in this case."""
    settings = cases.SHORT.replace(
        processing=cases.SHORT.processing.replace(directions="2d:1000", range_m=(0.4, 1.0)),
        accuracy=cases.SHORT.accuracy.replace(precision=precision),
    )
    pipeline, measurement = Pipeline(settings), cases.noise(settings)
    assert len({pipeline.process(measurement).amplitude.tobytes() for _ in range(30)}) == 1


def test_kernels_are_independent_of_the_number_of_threads():
    cpu = KERNELS["cpu"]
    signals, offsets, weights, shape = beam_input("eRTIS")
    words, channels = words_of("eRTIS")
    results = []
    for count in range(1, cpu.max_threads + 1):
        with cpu.threads(count):
            amplitude, demodulated = filled(*shape), filled(len(channels), 300)
            cpu.delay_and_sum_envelope(signals, offsets, weights, 0, shape[1], amplitude)
            cpu.demodulate_words(
                words, channels, np.arange(-30, 31, dtype=np.int16), np.float32(1), 10, 20, 300, demodulated
            )
        results.append(amplitude.tobytes() + demodulated.tobytes())
    assert len(set(results)) == 1


def add_paths_plainly(call, turns, amplitude, first_bin, nodes_per_bin, out):
    """Evaluate the equation of `AddPaths` bin by bin."""
    n_nodes = amplitude.shape[2]
    for path, mic, k in np.ndindex(*turns.shape, out.shape[1]):
        place = min((first_bin + k) * nodes_per_bin, n_nodes - 1)
        low = min(int(place), max(n_nodes - 2, 0))
        high = min(low + 1, n_nodes - 1)
        gain = amplitude[path, mic, low] + (place - low) * (amplitude[path, mic, high] - amplitude[path, mic, low])
        turned = np.exp(-2j * np.pi * turns[path, mic] * (first_bin + k))
        out[mic, k] += gain * call[mic if len(call) > 1 else 0, k] * turned


@pytest.mark.parametrize("one_call", [True, False])
@pytest.mark.parametrize(
    ("n_paths", "n_mics", "n_bins", "n_nodes", "first_bin"),
    [(0, 2, 5, 1, 0), (1, 1, 1, 1, 0), (3, 2, 21, 1, 7), (2, 3, 100, 5, 0), (1, 2, 333, 40, 11)],
)
def test_add_paths_equals_its_reference(kernel_set, one_call, n_paths, n_mics, n_bins, n_nodes, first_bin):
    random = np.random.default_rng(4)
    call = random.standard_normal((2, 1 if one_call else n_mics, n_bins))
    call = call[0] + 1j * call[1]
    turns = random.uniform(-0.5, 3.0, (n_paths, n_mics))
    amplitude = random.standard_normal((n_paths, n_mics, n_nodes))
    before = random.standard_normal((n_mics, n_bins)) * (1 + 1j)
    out, wanted = before.copy(), before.copy()
    kernel_set.add_paths(call, turns, amplitude, first_bin, 0.1, out)
    add_paths_plainly(call, turns, amplitude, first_bin, 0.1, wanted)
    np.testing.assert_allclose(out, wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("coherent", [0, 1])
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("n_samples", sized([5, 130], [64, 127, 128, 1000]))
def test_combine_delayed_equals_its_reference(kernel_set, n_samples, order, coherent):
    n_directions, n_mics, first = 3, 7, 4
    delays = np.random.default_rng(1).integers(0, 9, (n_directions, n_mics)).astype(np.int32)
    signals = real_noise(n_mics, n_samples + 20)
    signals[:, :20] = 0  # Some samples are 0 in all microphones.
    roots = (np.sign(signals) * np.abs(signals) ** (1 / order)).astype(np.float32)
    out, expected = filled(n_directions, n_samples), np.empty((n_directions, n_samples))
    kernel_set.combine_delayed(signals, roots, delays, order, coherent, first, out)
    for direction, delay in enumerate(delays):
        x, root = (
            np.stack([row[first + d : first + d + n_samples] for row, d in zip(each.astype(float), delay, strict=True)])
            for each in (signals, roots)
        )
        value = sum(np.prod(chosen, axis=0) for chosen in itertools.combinations(x if order == 1 else root, order))
        if coherent:
            power = n_mics * (x**2).sum(axis=0)
            value = value * np.divide(x.sum(axis=0) ** 2, power, out=np.zeros(n_samples), where=power > 0)
        expected[direction] = value
    assert np.abs(out - expected).max() <= FLOAT32 * np.abs(expected).max()


@pytest.mark.parametrize("n_mics", [1, 7])
@pytest.mark.parametrize("size", sized([5, 130], [64, 127, 128, 1000]))
def test_sum_delayed_int16_equals_its_reference(kernel_set, size, n_mics):
    random, largest, units = np.random.default_rng(1), 32_767 // n_mics, np.float32([0.5, 3.0, 0.25])
    delays = random.integers(0, 9, (35, n_mics)).astype(np.int32)
    tiles = random.integers(-largest, largest + 1, (3, n_mics, size + 8)).astype(np.int16)
    tiles[1] = largest
    out, expected = filled(35, 3 * size), np.zeros((35, 3, size))
    kernel_set.sum_delayed_int16(tiles, units, delays, out)
    for direction, tile, mic in np.ndindex(35, 3, n_mics):
        begin = delays[direction, mic]
        expected[direction, tile] += units[tile] * tiles[tile, mic, begin : begin + size].astype(float)
    assert np.array_equal(out, expected.reshape(35, -1))


@pytest.mark.parametrize(
    ("n_taps", "factor", "first", "n_ranges"), sized([(8, 3, 2, 6)], [(512, 10, 0, 450), (1, 1, 0, 9)])
)
def test_rectify_and_decimate_equals_its_reference(kernel_set, n_taps, factor, first, n_ranges):
    beams = real_noise(3, first + (n_ranges - 1) * factor + n_taps)
    beams[1] = 0
    taps = np.random.default_rng(2).integers(-128, 128, n_taps).astype(np.int16)
    out = filled(3, n_ranges)
    kernel_set.rectify_and_decimate(beams, taps, 0.25, factor, first, out)
    magnitude = np.abs(beams.astype(float))
    expected = [[row[first + r * factor :][:n_taps] @ taps / 4 for r in range(n_ranges)] for row in magnitude]
    rounding = np.abs(taps).sum() / 4 * np.abs(beams).max() / 2**16
    assert np.abs(out - expected).max() <= FLOAT32 * np.abs(expected).max() + rounding


def test_rectify_and_decimate_does_not_overflow(kernel_set):
    """Magnitudes are as large as they can be, and so are the sums of the taps."""
    beams, taps = np.full((1, 300), -7.0, np.float32), np.full(16, 16_383, np.int16)
    out = filled(1, 5)
    kernel_set.rectify_and_decimate(beams, taps, 1.0, 2, 0, out)
    assert out == pytest.approx(16 * 16_383 * 7.0, rel=1e-4)
