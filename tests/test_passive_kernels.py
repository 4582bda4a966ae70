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
