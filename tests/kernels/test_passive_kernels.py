"""Kernels of passive listening, on every device: equal to their equations in float64."""

import numpy as np
import pytest

from tests.on_device import KERNELS, sized

GARBAGE = 12_345.0
SHAPES = {
    # microphones, blocks, bins of the spectra, first bin, bins of the matrices, directions
    "least": (1, 1, 1, 0, 1, 1),
    "two": (2, 1, 5, 1, 3, 4),
    "odd": (3, 4, 40, 7, 33, 5),
    "few blocks": (7, 2, 33, 0, 33, 33),
    "eRTIS": (32, 63, 257, 11, 92, 90),
    "many directions": (32, 8, 65, 3, 17, 3000),
    "many microphones": (130, 3, 20, 2, 5, 40),
}
NAMES = sized(["least", "two", "odd", "few blocks"], ["eRTIS", "many directions", "many microphones"])


@pytest.fixture(params=KERNELS)
def kernel_set(request):
    return KERNELS[request.param]


def complex_noise(random, shape):
    return random.standard_normal((*shape, 2)).astype(np.float32).view(np.complex64)[..., 0]


@pytest.mark.parametrize("name", NAMES)
def test_cross_spectra_equal_their_reference(kernel_set, name):
    n_mics, n_blocks, n_bins, first, n_out, _ = SHAPES[name]
    spectra = complex_noise(np.random.default_rng(1), (n_mics, n_blocks, n_bins))
    out = np.full((n_out, n_mics, n_mics), GARBAGE, np.complex64)
    kernel_set.cross_spectra(spectra, first, out)
    heard = spectra[:, :, first : first + n_out].astype(complex)
    expected = np.einsum("ibk,jbk->kij", heard, heard.conj())
    assert np.abs(out - expected).max() < 2e-6 * np.abs(expected).max()


@pytest.mark.parametrize("name", NAMES)
def test_steered_power_equals_its_reference(kernel_set, name):
    n_mics, n_blocks, _, _, n_bins, n_directions = SHAPES[name]
    random = np.random.default_rng(2)
    spectra = complex_noise(random, (n_bins, n_mics, n_blocks)).astype(complex)
    matrices = (spectra @ spectra.conj().transpose(0, 2, 1)).astype(np.complex64)
    steps = random.integers(0, 2**32, (n_mics, n_directions), dtype=np.uint32)
    bins = np.concatenate([np.arange(n_bins - n_bins // 3), 1000 + np.arange(n_bins // 3)]).astype(np.uint32)  # a gap
    out = np.full((n_bins, n_directions), GARBAGE, np.float32)
    kernel_set.steer_power(matrices, steps, bins, out)
    lags = np.exp(-2j * np.pi * (bins[:, None, None].astype(float) * steps / 2**32 % 1))
    expected = (lags.conj() * (matrices.astype(complex) @ lags)).real.sum(axis=1)
    assert np.abs(out - expected).max() < 3e-6 * np.abs(matrices).sum(axis=(1, 2)).max()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n_vectors", [1, 2, 5])
def test_steered_vectors_equal_their_reference(kernel_set, name, n_vectors):
    n_mics, _, _, _, n_bins, n_directions = SHAPES[name]
    random = np.random.default_rng(5)
    vectors = complex_noise(random, (n_bins, n_vectors, n_mics))
    steps = random.integers(0, 2**32, (n_mics, n_directions), dtype=np.uint32)
    bins = np.concatenate([np.arange(n_bins - n_bins // 3), 1000 + np.arange(n_bins // 3)]).astype(np.uint32)  # a gap
    out = np.full((n_bins, n_directions), GARBAGE, np.float32)
    kernel_set.steer_vectors(vectors, steps, bins, out)
    lags = np.exp(-2j * np.pi * (bins[:, None, None].astype(float) * steps / 2**32 % 1))
    expected = (np.abs(vectors.conj().astype(complex) @ lags) ** 2).sum(axis=1)
    assert np.abs(out - expected).max() < 3e-6 * (np.abs(vectors).sum(axis=2) ** 2).sum(axis=1).max()


@pytest.mark.parametrize("device", KERNELS)
def test_only_the_upper_triangle_and_the_real_diagonal_are_read(device):
    random = np.random.default_rng(3)
    matrices = complex_noise(random, (2, 5, 5))
    steps, bins = random.integers(0, 2**32, (5, 7), dtype=np.uint32), np.array([4, 5], np.uint32)
    found = np.empty((2, 2, 7), np.float32)
    KERNELS[device].steer_power(matrices, steps, bins, found[0])
    spoilt = np.triu(matrices) + np.tril(np.full((5, 5), GARBAGE), -1).astype(np.complex64)
    spoilt[:, np.arange(5), np.arange(5)] += 3j
    KERNELS[device].steer_power(spoilt, steps, bins, found[1])
    assert np.array_equal(*found)


def reference_sources(matrix, waves, power, *, hollow):
    """Return the sources of CLEAN-SC in float64, with the components solved to rounding."""
    n_mics = len(matrix)
    norm = n_mics**2 - n_mics if hollow else n_mics**2
    rest, left, found, peaks = matrix * (1 - hollow * np.eye(n_mics)), power.copy(), np.zeros_like(power), []
    while len(peaks) < 2 * n_mics and left.max() > 0:
        place, peak = left.argmax(), left.max()
        peaks.append(peak)
        found[place] += 0.6 * peak
        if len(peaks) > 5 and peak > peaks[-4]:
            break
        weights = waves[:, place] / np.sqrt(norm)
        component = seen = rest @ weights / peak
        for _ in range(100 if hollow else 0):
            own = np.abs(component) ** 2
            component = (seen + own * weights) / np.sqrt(1 + own.sum() / norm)
        shared = 0.6 * peak * np.outer(component, component.conj()) * (1 - hollow * np.eye(n_mics))
        rest = rest - shared
        left = left - np.einsum("id,ij,jd->d", waves.conj(), shared, waves, optimize=True).real / norm
    return found


@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("name", [name for name in NAMES if name != "least"])  # one microphone finds no directions
def test_sources_equal_their_reference(kernel_set, name, hollow):
    """Two incoherent sources of 10 and 4, and noise of 0.01: their powers do not depend on the order of rounds."""
    n_mics, _, _, _, n_bins, n_directions = SHAPES[name]
    n_bins = min(n_bins, 5)
    random = np.random.default_rng(4)
    steps = random.integers(0, 2**32, (n_mics, n_directions), dtype=np.uint32)
    bins = np.arange(7, 7 + n_bins, dtype=np.uint32)
    waves = np.exp(-2j * np.pi * (bins[:, None, None].astype(float) * steps / 2**32 % 1))
    first, second = waves[:, :, 0], waves[:, :, -1]
    matrices = 10 * first[:, :, None] * first[:, None].conj() + 4 * second[:, :, None] * second[:, None].conj()
    matrices = np.ascontiguousarray(matrices + 0.01 * np.eye(n_mics), np.complex64)
    taken = matrices * (1 - hollow * np.eye(n_mics))
    norm = n_mics**2 - n_mics if hollow else n_mics**2
    powers = np.einsum("kid,kij,kjd->kd", waves.conj(), taken, waves, optimize=True).real / norm
    out = np.full((n_bins, n_directions), GARBAGE, np.float32)
    kernel_set.clean_sources(matrices, steps, bins, np.ascontiguousarray(powers, np.float32), hollow, out)
    cases = zip(matrices.astype(complex), waves, powers, strict=True)
    expected = np.array([reference_sources(*case, hollow=hollow) for case in cases])
    large = expected > 0.05
    assert out[large] == pytest.approx(expected[large], rel=0.02)
    assert np.abs(out - expected)[~large].max(initial=0) < 0.1


@pytest.mark.parametrize("device", KERNELS)
@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_map_without_positive_powers_has_no_sources(device, value, hollow):
    steps, bins = np.zeros((3, 5), np.uint32), np.array([4, 5], np.uint32)
    out = np.full((2, 5), GARBAGE, np.float32)
    powers = np.full((2, 5), value, np.float32)
    KERNELS[device].clean_sources(np.zeros((2, 3, 3), np.complex64), steps, bins, powers, hollow, out)
    assert not out.any()
