"""Coherence factor, DMAS and Capon: equality with their references, limits, and benefits."""

import re
import warnings
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.adaptive import AdaptiveBeamform
from ertis_numba.pipeline.verification import combine
from ertis_numba.settings import Processing
from ertis_numba.settings.beamformers import (
    ADAPTIVE_COMBINATIONS,
    BEAMFORMERS,
    WEIGHTINGS,
    BeamformerName,
    WeightingName,
)
from tests import reference
from tests.on_device import KERNELS, sized
from tests.pages import page

FLOAT32 = 2e-6  # relative to the largest number of an image
SHAPES = {
    # microphones, phases, samples, ranges, directions
    "two microphones": (2, 1, 40, 30, 3),
    "one range": (4, 2, 10, 1, 2),
    "just over a tile": (3, 2, 150, 131, 2),
    "prime": (7, 5, 211, 151, 13),
    "over a tile": (5, 2, 300, 257, 3),
    "eRTIS": (32, 10, 120, 70, 5),
    "many microphones": (129, 2, 40, 33, 2),
}


@pytest.fixture(params=KERNELS)
def kernel_set(request):
    return KERNELS[request.param]


def complex_noise(*shape, seed=1):
    random = np.random.default_rng(seed)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)


def beam_input(name):
    n_mics, n_phases, n_samples, n_ranges, n_directions = SHAPES[name]
    random = np.random.default_rng(2)
    row = np.arange(n_mics) * n_phases + random.integers(0, n_phases, (n_directions, n_mics))
    offsets = row * n_samples + random.integers(0, n_samples - n_ranges + 1, (n_directions, n_mics))
    weights = complex_noise(n_directions, n_mics, seed=3)
    return complex_noise(n_mics, n_phases, n_samples), offsets.astype(np.int32), weights, (n_directions, n_ranges)


def combined(kernel_set, beamformer, signals, **options):
    """Output of a beamformer for signals that reach all microphones at once: (range,) float32."""
    n_mics, n_ranges = signals.shape
    weights = np.full((1, n_mics), 1 / n_mics, dtype=np.complex64)
    offsets = np.arange(n_mics, dtype=np.int32)[None] * n_ranges
    out = np.full((1, n_ranges), 12_345, dtype=np.float32)
    processing = Processing(beamformer=beamformer, **options)
    beamform = AdaptiveBeamform(processing, kernel_set, kernel_set.memory(), offsets, weights)
    beamform(np.ascontiguousarray(signals, dtype=np.complex64)[:, None], (), out)
    return out[0]


def all_of(kernel_set, name):
    """Images of all three kernels, one after the other."""
    signals, offsets, weights, shape = beam_input(name)
    out = np.full((3, *shape), 1, dtype=np.float32)
    kernel_set.weight_coherence(signals, offsets, weights, out[0])
    kernel_set.combine_dmas(signals, offsets, weights, 2, out[1])
    kernel_set.combine_capon(signals, offsets, weights, 5, 1.0, out[2])
    return out


@pytest.mark.parametrize("name", sized([*SHAPES][:3], [*SHAPES][3:]))
def test_coherence_factor_equals_its_reference(kernel_set, name):
    signals, offsets, weights, shape = beam_input(name)
    given = np.abs(complex_noise(*shape, seed=4))
    out = given.copy()
    kernel_set.weight_coherence(signals, offsets, weights, out)
    expected = given * reference.coherence_factor(signals, offsets, weights, shape[1])
    assert np.abs(out - expected).max() < FLOAT32 * expected.max()


@pytest.mark.parametrize(
    ("name", "order"),
    sized(
        [("two microphones", 2), ("one range", 3), ("just over a tile", 3)],
        [("prime", 5), ("prime", 7), ("over a tile", 4), ("eRTIS", 2), ("eRTIS", 3), ("many microphones", 2)],
    ),
)
def test_dmas_equals_the_sum_of_all_products(kernel_set, name, order):
    signals, offsets, weights, shape = beam_input(name)
    out = np.full(shape, 12_345, dtype=np.float32)
    kernel_set.combine_dmas(signals, offsets, weights, order, out)
    expected = reference.dmas(signals, offsets, weights, order, shape[1])
    assert np.abs(out - expected).max() < FLOAT32 * expected.max()


@pytest.mark.parametrize("name", sized(["two microphones", "one range"], [*SHAPES][2:]))
@pytest.mark.parametrize(("n_snapshots", "loading"), [(5, 0.1), (1, 1e-3), (8, 1e-6), (4, 10.0), (32, 0.1)])
def test_capon_equals_its_reference(kernel_set, name, n_snapshots, loading):
    signals, offsets, weights, shape = beam_input(name)
    out = np.full(shape, 12_345, dtype=np.float32)
    kernel_set.combine_capon(signals, offsets, weights.astype(np.complex128), n_snapshots, loading, out)
    expected = reference.capon(signals, offsets, weights, n_snapshots, loading, shape[1])
    assert np.abs(out - expected).max() < FLOAT32 * expected.max()


@pytest.mark.parametrize("name", sized(["two microphones", "one range"], [*SHAPES][2:]))
@pytest.mark.parametrize(("n_snapshots", "loading"), [(5, 1.0), (1, 0.1), (8, 0.1), (4, 10.0), (32, 1.0)])
def test_capon_in_single_precision_equals_its_reference(kernel_set, name, n_snapshots, loading):
    signals, offsets, weights, shape = beam_input(name)
    out = np.full(shape, 12_345, dtype=np.float32)
    kernel_set.combine_capon(signals, offsets, weights, n_snapshots, loading, out)
    expected = reference.capon(signals, offsets, weights, n_snapshots, loading, shape[1])
    assert np.abs(out - expected).max() < (FLOAT32 + 3e-7 * offsets.shape[1] / loading) * expected.max()


@pytest.mark.parametrize("name", sized(["one range", "just over a tile"], ["two microphones", "prime", "eRTIS"]))
@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_every_beamformer_equals_its_definition(kernel_set, beamformer, weighting, name):
    signals, offsets, weights, (n_directions, n_ranges) = beam_input(name)
    processing, n_mics = Processing(beamformer=beamformer, weighting=weighting), offsets.shape[1]
    weights /= np.abs(weights).sum(axis=1, keepdims=True)
    out = np.full((n_directions, n_ranges), 12_345, dtype=np.float32)
    AdaptiveBeamform(processing, kernel_set, kernel_set.memory(), offsets, weights)(signals, (), out)
    delayed = n_mics * reference.delayed(signals, offsets, weights, n_ranges)
    expected = np.stack([combine(y, processing) for y in delayed])
    assert np.abs(out - expected).max() < 2 * FLOAT32 * expected.max()


@pytest.mark.parametrize("name", BEAMFORMERS)
def test_page_lists_every_beamformer_with_its_options(name):
    first_table = page("beamformers").partition("| weighting |")[0]
    (row,) = re.findall(rf"^\| `{name}` \|([^|]*)\|[^|]+\|[^|]+\|$", first_table, re.MULTILINE)
    options = {option.name for option in BEAMFORMERS[name].options}
    assert set(re.findall(r"`(\w+)`", row)) - {"array_weights"} == options


@pytest.mark.parametrize("name", WEIGHTINGS)
def test_page_lists_every_weighting(name):
    assert re.search(rf"^\| `{name}` \|[^|]+\|[^|]+\|$", page("beamformers"), re.MULTILINE)


def test_registry_names_are_those_of_the_type():
    assert tuple(BEAMFORMERS) == get_args(BeamformerName)
    assert tuple(WEIGHTINGS) == get_args(WeightingName)
    options = {option.name for each in BEAMFORMERS.values() for option in each.options}
    assert options <= set(Processing.__struct_fields__)


@pytest.mark.parametrize(
    "option", [option for each in BEAMFORMERS.values() for option in each.options], ids=lambda option: option.name
)
def test_options_keep_their_limits(option):
    for value in (option.limits.low, option.limits.high):
        assert getattr(Processing(**{option.name: value}), option.name) == value
    for value in (option.limits.low - 1, option.limits.high + 1):
        with pytest.raises(ArgumentError, match=f"processing.{option.name}"):
            Processing(**{option.name: value})


def test_results_do_not_depend_on_the_number_of_threads():
    cpu, found = KERNELS["cpu"], set()
    for count in range(1, cpu.max_threads + 1):
        with cpu.threads(count):
            found.add(all_of(cpu, "prime").tobytes())
    assert cpu.max_threads > 1
    assert len(found) == 1


@pytest.mark.parametrize("n_mics", [2, 8, 31])
@pytest.mark.parametrize(
    ("beamformer", "options"),
    [("delay_and_sum", {"weighting": "coherence_factor"}), ("capon", {})]
    + [("capon", {"diagonal_loading": 1e-6, "snapshots": 32})]
    + [("dmas", {"dmas_order": order}) for order in (2, 5, 8)],
)
def test_coherent_signals_keep_their_level(kernel_set, beamformer, options, n_mics):
    if options.get("dmas_order", 2) > n_mics:
        options = {"dmas_order": n_mics}
    signal = complex_noise(50)
    found = combined(kernel_set, beamformer, np.tile(signal, (n_mics, 1)), **options)
    np.testing.assert_allclose(found, np.abs(signal), rtol=3e-6)


@pytest.mark.parametrize(
    ("beamformer", "weighting", "order"), [*((*both, 2) for both in ADAPTIVE_COMBINATIONS), ("dmas", "none", 5)]
)
def test_beamformers_scale_with_the_amplitude(kernel_set, beamformer, weighting, order):
    signals, options = complex_noise(8, 40), {"weighting": weighting, "dmas_order": order}
    found = [combined(kernel_set, beamformer, scale * signals, **options) for scale in (1, 2, 1e-12)]
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=2e-5)
    np.testing.assert_allclose(found[2], 1e-12 * found[0], rtol=2e-5)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("beamformer", ["delay_and_sum", "capon"])
def test_beamformer_of_one_microphone_is_its_envelope(kernel_set, beamformer, weighting):
    signals = complex_noise(1, 40)
    found = combined(kernel_set, beamformer, signals, weighting=weighting)
    np.testing.assert_allclose(found, np.abs(signals[0]), rtol=1e-6)


def test_capon_with_high_diagonal_loading_is_delay_and_sum(kernel_set):
    signals = complex_noise(8, 40)
    expected = np.abs(signals.mean(axis=0))
    np.testing.assert_allclose(combined(kernel_set, "capon", signals, diagonal_loading=1e6), expected, rtol=1e-4)


@pytest.mark.parametrize("loading", [1e-3, 0.1, 10.0])
def test_capon_of_one_snapshot_depends_on_the_coherence_factor_only(kernel_set, loading):
    signals = complex_noise(8, 40)
    beams = np.abs(signals.mean(axis=0))
    factor = combined(kernel_set, "delay_and_sum", signals, weighting="coherence_factor") / beams
    expected = beams * loading / (loading + 8 * (1 - factor))
    np.testing.assert_allclose(
        combined(kernel_set, "capon", signals, snapshots=1, diagonal_loading=loading), expected, rtol=1e-5
    )


# Hard cases, and how the plain form fails.


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_beamformers_give_zero_for_silence(kernel_set, beamformer, weighting):
    """The following signal, here the second half, is unaffected."""
    signals = complex_noise(4, 40)
    signals[:, :20] = 0
    found = combined(kernel_set, beamformer, signals, weighting=weighting, snapshots=3)
    assert not found[:19].any()
    alone = combined(kernel_set, beamformer, signals[:, 20:], weighting=weighting, snapshots=3)
    np.testing.assert_allclose(found[21:], alone[1:], rtol=1e-6)
    assert alone.all()


def test_naive_forms_fail_on_silence():
    y = np.zeros((4, 3), dtype=np.complex64)
    with np.errstate(all="ignore"):
        assert np.isnan(np.abs(y.sum(axis=0)) ** 2 / (4 * (np.abs(y) ** 2).sum(axis=0))).all()
        assert np.isnan(y / np.abs(y) ** 0.5).all()
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(y @ y.conj().T, np.ones(4))


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_capon_in_single_precision_is_accurate_at_any_amplitude(kernel_set, scale):
    """Squares of these amplitudes exceed the limits of float32. Silence and NaN affect only their own ranges."""
    signals = np.float32(scale) * complex_noise(8, 40)
    signals[:, 20:26], signals[3, 33] = 0, np.nan
    offsets, out = np.arange(8, dtype=np.int32)[None] * 40, np.empty((2, 1, 40), dtype=np.float32)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for each, dtype in zip(out, (np.complex64, np.complex128), strict=True):
            kernel_set.combine_capon(signals[:, None], offsets, np.ones((1, 8), dtype), 3, 0.5, each)
    assert np.flatnonzero(~np.isfinite(out[0, 0])).tolist() == [32, 33, 34]
    assert not out[:, 0, 20:26].any()
    np.testing.assert_allclose(out[0], out[1], rtol=2e-5)


def test_capon_has_double_precision_where_single_precision_may_exceed_the_budget():
    """32 microphones; kernels use the precision of their weights."""
    offsets, weights = np.zeros((1, 32), np.int32), np.full((1, 32), 1 / 32, np.complex64)
    used = {}
    for loading, budget_db in ((1.0, -35.0), (1e-2, -35.0), (1e-3, -35.0), (1.0, -100.0)):
        kept = []
        kernels = SimpleNamespace(combine_capon=lambda _signals, _offsets, weights, *_, kept=kept: kept.append(weights))
        processing = Processing(beamformer="capon", diagonal_loading=loading)
        budget = 10 ** (budget_db / 10)
        beamform = AdaptiveBeamform(processing, kernels, KERNELS["cpu"].memory(), offsets, weights, budget=budget)
        beamform(np.zeros((32, 1, 1), np.complex64), (), np.zeros((1, 1), np.float32))
        used[loading, budget_db] = kept[0].dtype
    assert list(used.values()) == [np.complex64, np.complex64, np.complex128, np.complex128]


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_beamformers_of_tiny_signals_are_finite(kernel_set, beamformer, weighting):
    """Their squares underflow in single precision, so the naive root is infinite."""
    signals = np.full((4, 40), 1e-25 + 1e-25j, dtype=np.complex64)
    with np.errstate(all="ignore"):
        power = signals.real**2 + signals.imag**2
        assert not np.isfinite(signals * power ** np.float32(-0.25)).any()
    found = combined(kernel_set, beamformer, signals, weighting=weighting)
    assert np.all(np.isfinite(found))
    assert found.max() <= 1.5e-25


def test_loud_microphone_does_not_mask_dmas_products_of_others(kernel_set):
    """Power sums with Newton's identities lose all products without the loud microphone."""
    signals = complex_noise(8, 200)
    signals[3] *= 1e10
    order = 4
    weights, offsets = np.ones((1, 8), dtype=np.complex64), np.arange(8, dtype=np.int32)[None] * 200
    expected = reference.dmas(signals[:, None], offsets, weights, order, 200)[0]
    out = np.empty((1, 200), dtype=np.float32)
    kernel_set.combine_dmas(signals[:, None], offsets, weights, order, out)
    z = (signals / np.abs(signals) ** np.float32(1 - 1 / order)).astype(np.complex64)
    sums = [(z**k).sum(axis=0) for k in range(order + 1)]
    newton = [np.ones(200, dtype=np.complex64)]
    for k in range(1, order + 1):
        newton.append(sum((-1) ** (i - 1) * newton[k - i] * sums[i] for i in range(1, k + 1)) / np.float32(k))
    assert newton[-1].dtype == np.complex64
    assert np.median(np.abs(np.abs(newton[-1]) / expected - 1)) > 0.1
    assert np.abs(out[0] / expected - 1).max() < 1e-4


def test_capon_of_nearly_equal_snapshots_is_accurate(kernel_set):
    """The covariance of few snapshots is singular, so its products lose their digits in single precision."""
    loading, random, signals = 1e-6, np.random.default_rng(5), np.ones((16, 5), dtype=np.complex64)
    signals += (3e-4 * random.standard_normal((16, 5))).astype(np.float32)
    covariance = signals.astype(complex) @ signals.astype(complex).conj().T
    assert np.linalg.cond(covariance) > 1e15
    weights, offsets = np.ones((1, 16), dtype=np.complex128), np.arange(16, dtype=np.int32)[None] * 5
    expected = reference.capon(signals[:, None], offsets, weights, 5, loading, 5)
    out = np.empty((1, 5), dtype=np.float32)
    kernel_set.combine_capon(signals[:, None], offsets, weights, 5, loading, out)
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    gram, beams = signals.conj().T @ signals, signals.conj().sum(axis=0)
    added = np.float32(loading) * np.trace(gram).real / np.float32(16)
    solved = np.linalg.solve(gram + added * np.eye(5, dtype=np.float32), beams)
    with np.errstate(divide="ignore"):
        single = added * np.abs(solved) / np.abs(16 - np.vdot(beams, solved))
    assert solved.dtype == np.complex64
    assert np.abs(single / expected[0] - 1).max() > 0.01


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_nan_affects_only_its_own_ranges(kernel_set, beamformer, weighting, value):
    reach = {"capon": 2}.get(beamformer, 0)  # half of its 5 snapshots
    signals = complex_noise(4, 300)
    signals[2, 100] = value
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy also says so
        found = combined(kernel_set, beamformer, signals, weighting=weighting)
    assert np.flatnonzero(~np.isfinite(found)).tolist() == list(range(100 - reach, 101 + reach))
