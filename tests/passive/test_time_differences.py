"""Time differences of arrival: right, and as uncertain as stated."""

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.passive import HeardSignals, time_differences
from ertis_numba.passive.wave_delays import WaveDelays
from tests.passive.test_acoustic_camera import settings_of, sound

RATE_HZ = 200e3


def delayed_noise(delays_s, *, noise=0.0, seed=0, n=8192):
    """Return band-limited noise with delays in seconds, and other noise, at each microphone."""
    random = np.random.default_rng(seed)
    frequency_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    source = np.fft.rfft(random.standard_normal(n))
    rows = [np.fft.irfft(source * np.exp(-2j * np.pi * frequency_hz * each), n) for each in delays_s]
    return (np.array(rows) + noise * random.standard_normal((len(rows), n))).astype(np.float32)


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
def test_delays_of_three_microphones_are_found(weighting):
    delays_s = (0.0, 13.3e-6, -41.7e-6)
    found = time_differences(
        delayed_noise(delays_s, noise=0.1), rate_hz=RATE_HZ, weighting=weighting, band_hz=(20e3, 80e3)
    )
    assert [(each.first, each.second) for each in found] == [(0, 1), (0, 2), (1, 2)]
    for each in found:
        assert each.delay_s == pytest.approx(delays_s[each.second] - delays_s[each.first], abs=0.2e-6)
        assert 0.9 < each.peak <= 1.001
        assert each.uncertainty_s < 0.1e-6


def reference_delay_s(rows, weighting, n_block):
    """Evaluate the generalised cross-correlation on a fine grid of delays, in float64 and without transforms."""
    window, times = np.hanning(n_block + 1)[:-1], np.arange(n_block)
    frequency_hz = np.arange(1, n_block // 2) * RATE_HZ / n_block
    waves = np.exp(-2j * np.pi * np.outer(frequency_hz, times) / RATE_HZ)
    starts = range(0, rows.shape[1] - n_block + 1, n_block // 2)
    first, second = (np.array([waves @ (row[s : s + n_block] * window) for s in starts]) for row in rows.astype(float))
    cross = (second * first.conj()).mean(axis=0)
    scale = np.sqrt((np.abs(first) ** 2).mean(axis=0) * (np.abs(second) ** 2).mean(axis=0))
    cross /= {"phat": np.abs(cross), "scot": scale, "none": 1.0}[weighting]
    delays_s = np.arange(-50e-6, 50e-6, 0.02e-6)
    return delays_s[(np.exp(2j * np.pi * np.outer(delays_s, frequency_hz)) @ cross).real.argmax()]


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
def test_delay_is_the_maximum_of_the_correlation(weighting):
    rows = delayed_noise((0.0, 7.7e-6), noise=1.0, n=4096)
    (found,) = time_differences(rows, rate_hz=RATE_HZ, weighting=weighting, max_delay_s=50e-6)
    assert found.delay_s == pytest.approx(reference_delay_s(rows, weighting, 200), abs=0.04e-6)


def heard_of_band(random, low_hz, high_hz, snr_db, n):
    """Return noise of a band at two microphones with a random delay, and the delay; both hear white noise of their own.

    The signal-to-noise ratio is that inside the band.
    """
    frequency_hz = np.fft.rfftfreq(2 * n, 1 / RATE_HZ)
    source = np.fft.rfft(random.standard_normal(2 * n)) * ((frequency_hz >= low_hz) & (frequency_hz <= high_hz))
    delay_s = random.uniform(-100e-6, 100e-6)
    rows = [np.fft.irfft(source * np.exp(-2j * np.pi * frequency_hz * each), 2 * n) for each in (0.0, delay_s)]
    noise = 10 ** (-snr_db / 20) * random.standard_normal((2, n))
    return (np.array(rows)[:, n // 2 : n // 2 + n] + noise).astype(np.float32), delay_s


def errors_in_uncertainties(weighting, band_hz, snr_db, n, *, n_draws=50):
    """Return the errors of random draws in stated uncertainties, except for infinite ones."""
    random = np.random.default_rng([*map(int, band_hz), snr_db + 100, n])
    errors = []
    for _ in range(n_draws):
        rows, delay_s = heard_of_band(random, *band_hz, snr_db, n)
        (found,) = time_differences(rows, rate_hz=RATE_HZ, weighting=weighting, max_delay_s=150e-6)
        assert abs(found.delay_s) <= 150e-6
        if np.isfinite(found.uncertainty_s):
            errors.append((found.delay_s - delay_s) / found.uncertainty_s)
    return np.array(errors)


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
@pytest.mark.parametrize(
    ("band_hz", "snr_db", "n"),
    [
        ((20e3, 80e3), -5, 32768),
        ((20e3, 80e3), 0, 4096),
        ((20e3, 80e3), 10, 1000),
        ((20e3, 80e3), 30, 4096),
        ((25e3, 35e3), 5, 4096),
        ((25e3, 35e3), 10, 4096),
        ((25e3, 35e3), 30, 32768),
        ((38e3, 42e3), 20, 4096),
        ((1e3, 99e3), 20, 1000),
    ],
)
def test_uncertainty_is_that_of_the_errors(weighting, band_hz, snr_db, n):
    errors = errors_in_uncertainties(weighting, band_hz, snr_db, n)
    assert len(errors) == 50
    assert 0.7 < np.sqrt(np.mean(errors**2)) < 1.3
    assert np.abs(errors).max() < 4


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
@pytest.mark.parametrize(
    ("band_hz", "snr_db", "n", "min_known"),
    [
        ((39.6e3, 40.4e3), 30, 32768, 50),
        ((39.6e3, 40.4e3), 10, 4096, 40),
        ((39.4e3, 40.1e3), 20, 32768, 50),
        ((39e3, 41e3), 10, 32768, 50),
        ((25e3, 35e3), 0, 4096, 40),
        ((20e3, 80e3), -5, 1000, 0),
    ],
)
def test_narrow_or_weak_sound_has_an_uncertainty_of_periods(weighting, band_hz, snr_db, n, min_known):
    errors = errors_in_uncertainties(weighting, band_hz, snr_db, n)
    assert len(errors) >= min_known
    assert len(errors) < 10 or np.sqrt(np.mean(errors**2)) < 1.3
    assert np.abs(errors).max(initial=0) < 4


def test_narrow_band_far_above_the_noise_has_no_uncertainty_of_periods():
    random = np.random.default_rng(8)
    for _ in range(30):
        rows, delay_s = heard_of_band(random, 38e3, 42e3, 20, 4096)
        (found,) = time_differences(rows, rate_hz=RATE_HZ, max_delay_s=150e-6)
        assert found.delay_s == pytest.approx(delay_s, abs=0.3e-6)
        assert found.uncertainty_s < 0.2e-6


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
@pytest.mark.parametrize("frequency_hz", [25e3, 33.3e3, 40e3, 40.123e3])
def test_tone_has_an_uncertainty_of_periods(frequency_hz, weighting):
    """The phase of a steady tone does not tell its periods apart, however loud it is."""
    time_s = np.arange(20_000) / RATE_HZ
    for seed in range(5):
        random = np.random.default_rng(seed)
        delay_s = random.uniform(-100e-6, 100e-6)
        rows = np.sin(2 * np.pi * frequency_hz * (time_s - np.array([[0.0], [delay_s]])))
        rows += 10.0 ** random.uniform(-3, -1) * random.standard_normal(rows.shape)
        (found,) = time_differences(rows.astype(np.float32), rate_hz=RATE_HZ, weighting=weighting, max_delay_s=150e-6)
        assert abs(found.delay_s - delay_s) < 3 * found.uncertainty_s
        assert 1 / frequency_hz < found.uncertainty_s < 150e-6


@pytest.mark.parametrize("apart", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("snr_db", [10, 40])
def test_uncertainty_covers_the_shift_by_an_echo(apart, snr_db):
    """Coherent echoes of one microphone, 3 to 15 dB weaker; ``apart`` is in the inverse of the width of the band."""
    random = np.random.default_rng([int(10 * apart), snr_db])
    for _ in range(20):
        rows, delay_s = heard_of_band(random, 20e3, 80e3, 200, 8192)
        late = np.fft.rfftfreq(8192, 1 / RATE_HZ)
        echo = np.fft.irfft(np.fft.rfft(rows[1]) * np.exp(-2j * np.pi * late * apart / 60e3))
        rows[1] += 10 ** (-random.uniform(3, 15) / 20) * echo
        rows += 10 ** (-snr_db / 20) * random.standard_normal(rows.shape)
        (found,) = time_differences(rows, rate_hz=RATE_HZ, max_delay_s=150e-6)
        assert abs(found.delay_s - delay_s) < 3 * found.uncertainty_s < 6e-6


@pytest.mark.parametrize("apart", [0.5, 1.0, 2.0])
def test_uncertainty_covers_the_shift_by_another_source(apart):
    """Independent sources of the same band; if they are about as loud, the uncertainty is about their distance."""
    random = np.random.default_rng(int(10 * apart))
    stated_s = []
    for _ in range(20):
        rows, delay_s = heard_of_band(random, 20e3, 80e3, 40, 8192)
        others, other_s = heard_of_band(random, 20e3, 80e3, 40, 8192)
        late = np.fft.rfftfreq(8192, 1 / RATE_HZ)
        moved_s = delay_s + apart / 60e3 - other_s
        others[1] = np.fft.irfft(np.fft.rfft(others[1]) * np.exp(-2j * np.pi * late * moved_s))
        rows += 10 ** (-random.uniform(1, 10) / 20) * others
        (found,) = time_differences(rows, rate_hz=RATE_HZ, max_delay_s=300e-6)
        assert abs(found.delay_s - delay_s) < 4 * found.uncertainty_s
        stated_s.append(found.uncertainty_s)
    assert np.median(stated_s) < 2e-6
    assert max(stated_s) < 1 / 60e3 * apart


def test_delay_beyond_the_largest_is_unknown():
    (found,) = time_differences(delayed_noise((0.0, 31e-6)), rate_hz=RATE_HZ, max_delay_s=29e-6)
    assert abs(found.delay_s) <= 29e-6
    assert found.uncertainty_s == np.inf


@pytest.mark.parametrize("weighting", ["phat", "scot", "none"])
def test_noise_without_coherence_has_no_uncertainty(weighting):
    random = np.random.default_rng(11)
    rows = random.standard_normal((40, 2, 4096)).astype(np.float32)
    found = [time_differences(each, rate_hz=RATE_HZ, weighting=weighting)[0].uncertainty_s for each in rows]
    assert np.isinf(found).sum() >= 38


def test_few_blocks_do_not_show_the_uncertainty():
    for n in (200, 300):  # one block and two
        (found,) = time_differences(delayed_noise((0.0, 7.7e-6), noise=1.0, n=n), rate_hz=RATE_HZ)
        assert found.uncertainty_s == np.inf


def test_peak_without_coherence_is_low():
    rows = np.random.default_rng(5).standard_normal((2, 8192))
    (found,) = time_differences(rows, rate_hz=RATE_HZ)
    assert found.peak < 0.5
    (silent,) = time_differences(np.zeros((2, 8192)), rate_hz=RATE_HZ, weighting="none")
    assert silent.uncertainty_s == np.inf


def test_measurement_has_the_delays_of_its_direction():
    settings = settings_of(array__delay_s=[2e-6, 0.0, 0.0, 0.0, 0.0, -3e-6])
    plain = settings_of()
    heard = sound(plain, [(20, 0.1)], noise=0.005)
    n, rate_hz = heard.data.shape[0], plain.recording.sample_rate_hz
    own = np.exp(-2j * np.pi * np.fft.rfftfreq(n, 1 / rate_hz) * np.array(settings.array.delay_s)[:, None])
    data = np.fft.irfft(np.fft.rfft(heard.data.T) * own, n).T
    found = time_differences(ertis.Measurement(np.ascontiguousarray(data, np.float32), settings))
    direction = ertis.geometry.unit_vectors(np.radians([20]), np.zeros(1))
    delay_s = WaveDelays(plain)(direction)[0]
    assert len(found) == 15
    for each in found:
        assert each.delay_s == pytest.approx(delay_s[each.second] - delay_s[each.first], abs=0.5e-6)


def test_bands_may_be_rows_of_arrays_and_delays_unlimited():
    rows, bands_hz = delayed_noise((0.0, 7.7e-6), noise=0.1), np.array([[20e3, 80e3]])
    expected = time_differences(rows, rate_hz=RATE_HZ, band_hz=(20e3, 80e3))
    assert time_differences(rows, rate_hz=RATE_HZ, band_hz=bands_hz[0], max_delay_s=1e308) == expected


def test_arguments_outside_their_limits_are_refused():
    rows, measurement = delayed_noise((0.0, 0.0)), sound(settings_of(), [])
    for words, arguments, options in (
        ("weighting", (rows,), {"rate_hz": RATE_HZ, "weighting": "roth"}),
        ("rate_hz is missing", (rows,), {}),
        ("rate_hz is given", (measurement,), {"rate_hz": RATE_HZ}),
        ("two microphones", (rows[:1],), {"rate_hz": RATE_HZ}),
        ("two microphones", (rows[0],), {"rate_hz": RATE_HZ}),
        ("resolution_hz", (rows,), {"rate_hz": RATE_HZ, "resolution_hz": 1.0}),
        ("resolution_hz", (rows,), {"rate_hz": RATE_HZ, "resolution_hz": 1e5}),
        ("band_hz", (rows,), {"rate_hz": RATE_HZ, "band_hz": (5e3, 1e6)}),
        ("none of the frequencies", (rows,), {"rate_hz": RATE_HZ, "band_hz": (5.1e3, 5.2e3)}),
        ("max_delay_s", (rows,), {"rate_hz": RATE_HZ, "max_delay_s": 0.0}),
        ("resolution_hz", (rows,), {"rate_hz": RATE_HZ, "resolution_hz": 1e-320}),
        ("band_hz", (rows,), {"rate_hz": RATE_HZ, "band_hz": ()}),
        ("band_hz", (rows,), {"rate_hz": RATE_HZ, "band_hz": np.zeros((2, 2))}),
        ("heard holds nan", (rows * np.nan,), {"rate_hz": RATE_HZ}),
        ("heard holds inf", (rows.astype(float) * 1e300,), {"rate_hz": RATE_HZ}),
        ("heard is of type str", ("rows",), {"rate_hz": RATE_HZ}),
        ("heard is of type list", ([[1.0, 2.0], [1.0]],), {"rate_hz": RATE_HZ}),
        ("real numbers", (rows * 1j,), {"rate_hz": RATE_HZ}),
        ("8 samples or more", (rows[:, :0],), {"rate_hz": RATE_HZ}),
        ("8 samples or more", (rows[:, :7],), {"rate_hz": RATE_HZ}),
    ):
        with pytest.raises(ArgumentError, match=words):
            time_differences(*arguments, **options)
    with HeardSignals(settings_of()) as signals:
        assert signals.band_hz == (20e3, 40e3)


@pytest.mark.parametrize("scale", [1e-35, 1e-18, 1e15, 1e19, 1e37])
@pytest.mark.parametrize("weighting", ["phat", "none"])
def test_loudness_does_not_change_time_differences(scale, weighting):
    rows = delayed_noise((0.0, 7.7e-6), noise=0.1)
    (expected,), (found,) = (
        time_differences((each * rows.astype(float)).astype(np.float32), rate_hz=RATE_HZ, weighting=weighting)
        for each in (1.0, scale)
    )
    assert found.delay_s == pytest.approx(expected.delay_s, abs=1e-9)
    assert found.uncertainty_s == pytest.approx(expected.uncertainty_s, rel=0.01)


def delayed(random, delay_s, band_hz=(2e3, 20e3), snr_db=30, n=9600):
    """Noise in a band at two microphones, with independent noise."""
    frequency_hz = np.fft.rfftfreq(n + 4096, 1 / 96e3)
    spectrum = np.fft.rfft(random.standard_normal(n + 4096))
    spectrum[(frequency_hz < band_hz[0]) | (frequency_hz > band_hz[1])] = 0
    turned = [spectrum, spectrum * np.exp(-2j * np.pi * frequency_hz * delay_s)]
    rows = np.fft.irfft(turned, n + 4096)[:, 2048 : 2048 + n]
    return rows / rows[0].std() + 10 ** (-snr_db / 20) * random.standard_normal((2, n))


@pytest.mark.parametrize("band_hz", [(2e3, 20e3), (8e3, 12e3)])
@pytest.mark.parametrize(
    "coarse",
    [np.sign, lambda rows: np.rint(0.6 * rows), lambda rows: np.rint(2 * rows), lambda rows: np.clip(rows, -0.5, 0.5)],
    ids=["sign", "0.6 steps", "2 steps", "limited"],
)
def test_uncertainty_covers_the_shift_by_coarse_or_limited_signals(coarse, band_hz):
    random = np.random.default_rng(8)
    deviations = []
    for delay_s in random.uniform(-2e-4, 2e-4, 12):
        rows = coarse(delayed(random, delay_s, band_hz)).astype("f4")
        (found,) = ertis.time_differences(rows, rate_hz=96e3)
        deviations.append((found.delay_s - delay_s) / found.uncertainty_s)
    assert np.sqrt(np.mean(np.square(deviations))) < 1.2
    assert np.abs(deviations).max() < 3


def test_constants_and_single_moments_are_no_sound():
    """A step or a click of both channels, as of their supply, shows no delay of sound."""
    random, time_s = np.random.default_rng(3), np.arange(9600) / 96e3
    noise = 1e-4 * random.standard_normal((2, 9600))
    click = delayed(random, 1e-4, snr_db=0)
    click[:, 4000] += 300
    for rows in (
        np.ones((2, 9600)),
        np.array([[0.1], [-0.3]]) * np.ones(9600),
        np.outer([1, 0.7], time_s > 0.05) + noise,
        np.outer([1, 1], np.arange(9600) == 500),
        click,
    ):
        (found,) = ertis.time_differences(rows.astype("f4"), rate_hz=96e3)
        assert np.isinf(found.uncertainty_s)
    (found,) = ertis.time_differences((delayed(random, 1e-4) + np.array([[3.0], [5.0]])).astype("f4"), rate_hz=96e3)
    assert abs(found.delay_s - 1e-4) < 4 * found.uncertainty_s < 1e-6
