"""CFAR detection: the false-alarm rate is the requested one, and reflectors beside clutter or each other are found."""

import functools
import math

import numpy as np
import pytest
import scipy.special

from ertis_numba.analysis.cfar import METHODS, _reference, cfar, cfar_peaks, threshold_factor
from ertis_numba.analysis.detect import find_peaks
from ertis_numba.analysis.range_cleaning import clean
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording, Settings
from tests.analysis.test_detect import image_of
from tests.cases import noise
from tests.pages import path_of

N = 32
SETTINGS = Settings()
MIDDLE = 18  # ranges lie one resolution apart and the guard is one bin, so 16 + 1 + 1 + 1 + 16 bins suffice
SPACING_M = 0.05


def rayleigh(n_rows, scale=1.0, *, seed=1, n_ranges=37):
    """Noise in many directions. Tests count one bin of each direction, so that the counts are independent."""
    values = np.random.default_rng(seed).rayleigh(size=(n_rows, n_ranges)) * scale
    angles = np.linspace(-1.0, 1.0, n_rows)
    return Energyscape(values.astype(np.float32), angles, np.zeros(n_rows), SPACING_M * np.arange(n_ranges), SETTINGS)


def interval(count, total, confidence=0.999):
    """Confidence interval of a probability after some successes in some trials (Clopper and Pearson, 1934)."""
    tail = (1 - confidence) / 2
    low = scipy.special.betaincinv(count, total - count + 1, tail) if count else 0.0
    return low, scipy.special.betaincinv(count + 1, total - count, 1 - tail)


def assert_share(found, wanted):
    """Assert that the share of true values agrees with a probability."""
    low, high = interval(int(np.count_nonzero(found)), found.size)
    assert low <= wanted <= high, (np.mean(found), wanted)


def exact(method, scales, false_alarm):
    """Probability that a bin of scale 1 is detected among reference bins of other scales, the first half before it.

    For the k-th lowest and for the greater half, by counting the bins below a threshold.
    """
    alpha = threshold_factor(method, N, false_alarm)
    power = np.asarray(scales, dtype=float) ** 2
    if method == "cell_averaging":  # the Laplace transform of a sum of exponential variables
        return float(np.prod(1 / (1 + alpha * power / N)))
    if method == "greatest_of":  # ∫ exp(−α max(a, b)) over both halves, as sums of equal exponentials each
        grid = np.linspace(0, 40, 40_001)
        halves = [scipy.special.gammainc(N // 2, grid * (N // 2) / part[0]) for part in (power[:16], power[16:])]
        cumulated = halves[0] * halves[1]
        return float(np.sum(np.exp(-alpha * (grid[1:] + grid[:-1]) / 2) * np.diff(cumulated)))
    # The k-th lowest bin is below x if k or more bins are; their count is the sum of two binomial counts.
    grid = np.linspace(0, 40, 8001)
    groups = [(np.count_nonzero(power == value), 1 - np.exp(-grid / value)) for value in np.unique(power)]
    counts = np.ones((len(grid), 1))
    for size, below in groups:
        each = np.stack([math.comb(size, i) * below**i * (1 - below) ** (size - i) for i in range(size + 1)], axis=1)
        counts = np.stack([np.convolve(a, b) for a, b in zip(counts, each, strict=True)])
    cumulated = counts[:, 24:].sum(axis=1)
    return float(np.sum(np.exp(-alpha * (grid[1:] + grid[:-1]) / 2) * np.diff(cumulated)))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("false_alarm", [1e-2, 1e-3, 1e-4])
def test_threshold_factor_gives_the_false_alarm_probability(method, false_alarm):
    """The probability is computed independently of the formula that the factor is solved from."""
    assert exact(method, np.ones(N), false_alarm) == pytest.approx(false_alarm, rel=0.01)


ROWS = {1e-2: 5_000, 1e-3: 30_000, 1e-4: 160_000}
"""Trials: for some twenty false alarms."""
STEP = np.where(np.arange(37) < MIDDLE, 0.1, 1.0)  # the middle bin is the first of the louder side
BESIDE = np.where((np.arange(37) >= MIDDLE + 5) & (np.arange(37) < MIDDLE + 8), 100.0, 1.0)  # 40 dB above the noise


@functools.lru_cache(maxsize=1)
def noise_for(false_alarm, scene):
    """Noise for as many trials as a probability needs; all methods see the same noise."""
    scale, seed = {"noise": (1.0, 1), "step": (STEP, 3), "reflector": (BESIDE, 4)}[scene]
    return rayleigh(ROWS[false_alarm], scale, seed=seed)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("false_alarm", [1e-2, 1e-3, 1e-4])
def test_false_alarm_rate_in_noise(method, false_alarm):
    """The rate holds in the middle and at both ends, at every noise level."""
    given = noise_for(false_alarm, "noise")
    found = cfar(given, false_alarm=false_alarm, method=method)
    for place in (0, MIDDLE, -1):
        assert_share(found[:, place], false_alarm)
    quieter = given.replace(
        amplitude=given.amplitude[:5000] * np.float32(2**-30),
        azimuth_rad=given.azimuth_rad[:5000],
        elevation_rad=given.elevation_rad[:5000],
    )
    np.testing.assert_array_equal(cfar(quieter, false_alarm=false_alarm, method=method), found[:5000])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("false_alarm", [1e-2, 1e-3, 1e-4])
def test_false_alarm_rate_beside_a_clutter_edge(method, false_alarm):
    """With a step of 20 dB, the rate at the edge is the theoretical one."""
    found = cfar(noise_for(false_alarm, "step"), false_alarm=false_alarm, method=method)
    wanted = exact(method, np.where(np.arange(N) < N // 2, 0.1, 1.0), false_alarm)
    assert_share(found[:, MIDDLE], wanted)
    # The quieter side has fewer false alarms than requested.
    assert interval(int(np.count_nonzero(found[:, MIDDLE - 1])), len(found))[0] <= false_alarm
    if method == "greatest_of":
        assert wanted < 6 * false_alarm
    else:
        assert wanted > 6 * false_alarm or false_alarm > 1e-3


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("false_alarm", [1e-2, 1e-3, 1e-4])
def test_false_alarm_rate_beside_a_strong_reflector(method, false_alarm):
    """With a reflector 40 dB above the noise, only the ordered statistic keeps some sensitivity."""
    found = cfar(noise_for(false_alarm, "reflector"), false_alarm=false_alarm, method=method)[:, MIDDLE]
    assert interval(int(np.count_nonzero(found)), len(found))[0] <= false_alarm
    if method == "ordered_statistic":
        scales = np.ones(N)
        scales[-3:] = 100.0
        wanted = exact(method, scales, false_alarm)
        assert_share(found, wanted)
        assert wanted > 0.15 * false_alarm
    else:
        assert not found.any()


@pytest.mark.parametrize("false_alarm", [1e-2, 1e-3])
def test_false_alarm_rate_in_images_of_one_bit_noise(false_alarm):
    """Images of microphones without a signal. Their ranges lie closer than the resolution."""
    settings = Settings(
        recording=Recording(n_samples=65_536), processing=Processing(directions="2d:9", range_m=(0.3, 2.0))
    )
    with Pipeline(settings, device="numpy", max_error_db=-30) as pipeline:
        shares = [np.mean(cfar(pipeline.process(noise(settings, seed)), false_alarm=false_alarm)) for seed in range(12)]
    deviation = np.std(shares) / math.sqrt(len(shares))
    assert np.mean(shares) == pytest.approx(false_alarm, abs=3 * deviation + 0.1 * false_alarm)


def reference_indices(place, count, *, step=2, guard=11):
    """Indices of the reference bins of a range: the nearest ones, half on each side if both sides have room."""
    before = [place - guard - step * n for n in range(1, 200) if place - guard - step * n >= 0]
    behind = [place + guard + step * n for n in range(1, 200) if place + guard + step * n < count]
    n_behind = min(len(behind), N - min(len(before), N // 2))
    return sorted(before[: N - n_behind] + behind[:n_behind])


def test_reference_bins_are_the_nearest_beyond_the_guard():
    """At the default range spacing: every other bin, beyond ten guard bins, and symmetric at both ends."""
    image = image_of([], directions="2d:2", range_m=(0.8, 1.7))
    count = image.amplitude.shape[1]
    places = _reference(image, N)
    for place in range(count):
        assert places[:, place].tolist() == reference_indices(place, count), place
        assert (places[:, place] == count - 1 - places[::-1, count - 1 - place]).all(), place  # mirrored
    assert places[:, 0].min() == 13


@pytest.mark.parametrize("method", METHODS)
def test_cfar_equals_a_bin_by_bin_reference(method):
    """Bins within rounding of the threshold may differ."""
    image = image_of([(12.0, 0.0, 1.3, 0.3)], directions="2d:5", range_m=(0.8, 1.7))
    values = np.random.default_rng(1).rayleigh(size=image.amplitude.shape) * 0.1
    image = image.replace(amplitude=(image.amplitude + values).astype(np.float32))
    alpha, count = threshold_factor(method, N, 1e-2), image.amplitude.shape[1]
    above = np.zeros(image.amplitude.shape)
    for direction, place in np.ndindex(above.shape):
        power = image.amplitude[direction, reference_indices(place, count)].astype(float) ** 2
        reported = {
            "ordered_statistic": np.sort(power)[23],
            "cell_averaging": power.mean(),
            "greatest_of": max(power[:16].mean(), power[16:].mean()),
        }[method]
        above[direction, place] = image.amplitude[direction, place].astype(float) ** 2 / (alpha * reported)
    sure = np.abs(above - 1) > 1e-5
    assert np.count_nonzero(~sure) <= 1
    assert (above > 1).any()
    np.testing.assert_array_equal(cfar(image, false_alarm=1e-2, method=method)[sure], above[sure] > 1)


def test_only_ordered_statistic_finds_weak_beside_strong_reflector():
    """The second reflector is 26 dB weaker and 20 cm farther away; it hides from methods that average."""
    image = image_of([(0.0, 0.0, 1.2, 1.0), (0.0, 0.0, 1.4, 0.05)], directions="2d:3", range_m=(0.9, 1.65))
    values = np.random.default_rng(1).rayleigh(size=image.amplitude.shape) * 0.002
    image = image.replace(amplitude=(image.amplitude + values).astype(np.float32))
    weak = np.argmin(np.abs(image.range_m - 1.4))
    found = {method: cfar(image, method=method)[1, weak - 2 : weak + 3].any() for method in METHODS}
    assert found == {"ordered_statistic": True, "cell_averaging": False, "greatest_of": False}


def test_clean_keeps_the_strongest_directions_of_each_range():
    image = image_of([], directions="2d:4", range_m=(0.9, 1.0))
    amplitude = np.zeros(image.amplitude.shape, np.float32)
    amplitude[:, 3] = [1.0, 0.55, 0.45, 0.1]
    amplitude[:, 5] = [0.0, 0.0, 0.02, 0.01]
    given = image.replace(amplitude=amplitude)
    kept = clean(given, within_db=6.0).amplitude
    np.testing.assert_array_equal(kept[:, 3], np.float32([1.0, 0.55, 0, 0]))
    np.testing.assert_array_equal(kept[:, 5], np.float32([0, 0, 0.02, 0]))  # one half is slightly above −6 dB
    assert not kept[:, [0, 1, 2, 4]].any()
    kept = clean(
        given, within_db=6.0, above_mean_db=6.0
    ).amplitude  # means: 0.525 at the first range, 0.0075 at the other
    assert not kept[:, 3].any()
    np.testing.assert_array_equal(kept[:, 5], np.float32([0, 0, 0.02, 0]))
    assert given.amplitude is amplitude


def test_clean_removes_side_lobes():
    image = image_of([(12.0, 0.0, 1.2, 1.0), (-40.0, 0.0, 1.4, 0.02)], directions="2d:181", range_m=(0.9, 1.6))
    kept = clean(image, within_db=10.0)
    lobes = np.flatnonzero(kept.amplitude[:, np.argmin(np.abs(image.range_m - 1.2))])
    assert np.ptp(np.degrees(image.azimuth_rad[lobes])) < 20
    assert kept.amplitude[50, np.argmin(np.abs(image.range_m - 1.4))] > 0  # 34 dB weaker but alone at its range


def test_cfar_peaks_finds_weak_reflectors():
    """The weaker reflector is 46 dB below the strongest and 14 dB above the noise."""
    reflectors = [(12.3, 0, 1.1, 1.0), (-33.3, 0, 1.45, 0.005)]
    image = image_of(reflectors, directions="2d:91", range_m=(0.9, 1.65))
    rng = np.random.default_rng(1)
    parts = rng.normal(size=(2, *image.amplitude.shape)) * 0.001 / math.sqrt(2)
    image = image.replace(amplitude=np.abs(image.amplitude + parts[0] + 1j * parts[1]).astype(np.float32))
    peaks = cfar_peaks(image)
    assert len(find_peaks(image)) == 1
    assert [peak.azimuth_deg for peak in peaks[:2]] == pytest.approx([12.3, -33.3], abs=3)
    assert peaks[1].level_db == pytest.approx(-46, abs=2)
    assert len(peaks) < 2 + 8  # out of 18,000 bins
    assert len(cfar_peaks(image, top=1)) == 1
    assert len(cfar_peaks(image, min_level_db=-20)) == 1


@pytest.mark.parametrize("method", METHODS)
def test_cfar_detects_nothing_in_silence(method):
    image = rayleigh(3)
    silent = image.replace(amplitude=np.zeros_like(image.amplitude))
    assert not cfar(silent, method=method).any()
    silent.amplitude[1, 20] = 1e-6
    assert np.argwhere(cfar(silent, method=method)).tolist() == [[1, 20]]
    assert not clean(image.replace(amplitude=np.zeros_like(image.amplitude))).amplitude.any()


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"false_alarm": 0.0}, "false_alarm is 0; use a number from 1e-09 to 0.5"),
        ({"method": "median"}, "method 'median' is unknown; known are ordered_statistic, cell_averaging, greatest_of"),
        ({"n_reference": 5}, "n_reference is 5; use an even number, with half the bins on each side"),
        ({"n_reference": 2}, "n_reference is 2; use a whole number from 4 to 512"),
        (
            {"n_reference": 64},
            "image has 37 ranges, but 64 reference bins need 69; choose an image with a wider range window",
        ),
    ],
)
def test_cfar_rejects_invalid_arguments(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        cfar(rayleigh(2), **arguments)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"within_db": -1.0}, "within_db is -1; use a number from 0 to 1000"),
        ({"above_mean_db": -1.0}, "above_mean_db"),
    ],
)
def test_clean_rejects_invalid_arguments(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        clean(rayleigh(2), **arguments)


def test_find_peaks_rejects_mask_of_wrong_shape():
    with pytest.raises(ArgumentError, match=r"where has shape \(2, 2\); pass shape"):
        find_peaks(rayleigh(4), where=np.ones((2, 2), dtype=bool))


def test_plots_page_lists_theoretical_false_alarm_rates():
    """The page has a table of false alarms beside a step of 20 dB."""
    page = path_of("plots").read_text("utf-8")
    step = np.where(np.arange(N) < N // 2, 0.1, 1.0)
    for false_alarm in ("1e-2", "1e-3", "1e-4"):
        row = " | ".join(f"{exact(method, step, float(false_alarm)):.1e}".replace("e-0", "e-") for method in METHODS)
        assert f"| {false_alarm} | {row} |" in page
