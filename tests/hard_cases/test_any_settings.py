"""Random settings and data: a finite, non-negative image or a one-line error.

The default number of examples takes some seconds; ``ERTIS_EXAMPLES`` sets another.
"""

import os

import numpy as np
import pytest
from hypothesis import Phase, event, given, settings, strategies as st

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.base.errors import ArgumentError, DataError, DeviceError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import observable_angles
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS
from tests.hard_cases.tuned import tuned

EXAMPLES = int(os.environ.get("ERTIS_EXAMPLES", "120"))
MAX_SAMPLES = 500_000
LOUDEST = 100.0  # limit of an image with a full scale of 1, before calibrated gains
DATA = ("noise", "zeros", "ones", "alternating", "sparse", "stuck")


def count_of(array):
    """Number of channels of an array; the built-in layouts have 32."""
    return 32 if array.positions_m is None else len(array.positions_m)


def limits(low, high):
    """Intervals, including those of width 0."""
    edges = st.floats(low, high, allow_subnormal=False)
    return st.tuples(edges, edges).map(lambda pair: (min(pair), max(pair))) | edges.map(lambda edge: (edge, edge))


@st.composite
def arrays(draw):
    """Arrays of 1 to 8, rarely 9 to 70 microphones, or a built-in layout; some coincide, and some are disabled."""
    if draw(st.integers(0, 9)) == 0:
        return Array(layout=draw(st.sampled_from(["eRTIS_v3D1", "uRTIS_v1"])))
    n_mics = draw(st.integers(1, 8) | st.sampled_from([9, 31, 33, 70]))
    reach_m = draw(st.sampled_from([0.0, 0.01, 0.1, 1.0]))
    places_m = reach_m * np.random.default_rng(draw(st.integers(0, 99))).uniform(-1, 1, (n_mics, 3))
    enabled = draw(st.none() | _mixed(st.booleans(), n_mics).map(lambda flags: flags if any(flags) else None))

    def each(values):
        return draw(st.none() | values.map(lambda value: (value,) * n_mics) | _mixed(values, n_mics))

    return Array(
        layout="any",
        positions_m=tuple(map(tuple, places_m.tolist())),
        enabled=enabled,
        gain=each(st.sampled_from([1e-3, 0.5, 1.0, 2.0, 1e3])),
        delay_s=each(st.sampled_from([-1e-3, -1e-6, 0.0, 3e-6, 1e-3])),
        word_bits=draw(st.sampled_from([8, 16, 32, 64])),
    )


def _mixed(values, n_mics):
    return st.lists(values, min_size=n_mics, max_size=n_mics).map(tuple)


@st.composite
def calls(draw):
    """Fields of sweeps of any direction, ramp and width, including very narrow ones."""
    sample_rate_hz = draw(st.floats(2e5, 1e6))
    low_hz = draw(st.floats(2e3, 4e4))
    high_hz = draw(st.floats(low_hz * 1.0001, min(9e4, sample_rate_hz * 0.499)))
    edges_hz = (low_hz, high_hz) if draw(st.booleans()) else (high_hz, low_hz)
    return {
        "start_frequency_hz": edges_hz[0],
        "stop_frequency_hz": edges_hz[1],
        "duration_s": draw(st.floats(16 / sample_rate_hz, 3e-3)),
        "sample_rate_hz": sample_rate_hz,
        "ramp_fraction": draw(st.floats(0, 0.5)),
    }


def some_of(fields):
    """Values of some fields; the others keep their defaults."""
    return st.fixed_dictionaries({}, optional=fields)


TUNING = {
    "precision": st.sampled_from(["auto", "float32", "int16"]),
    "oversampling": st.integers(1, 64),
    "max_error_db": st.sampled_from([-20.0, -35.0, -60.0, -100.0]) | st.floats(-120, 0),
    "delay_taps": st.sampled_from([None, None, 1, 2, 4, 8]),
    "beam_taps": st.sampled_from([None, 0, 2, 4, 6]),
    "beam_density": st.floats(1.1, 8),
    "stopband_attenuation_db": st.floats(40, 140),
    "focal_zones": st.integers(1, 4),
}
COMBINING = {
    "wavefront": st.sampled_from(["plane", "spherical"]),
    "beamformer": st.sampled_from(["delay_and_sum", *BEAMFORMERS]),
    "weighting": st.sampled_from(["none", *WEIGHTINGS]),
    "dmas_order": st.integers(2, 8),
    "snapshots": st.integers(1, 32),
    "diagonal_loading": st.floats(1e-6, 1e6),
}


@st.composite
def any_settings(draw):
    """Valid settings with records of 4 ms at most, or None if the constructors refuse the values."""
    rate_hz = draw(st.sampled_from([450e3, 9e5, 1.125e6, 4.5e6]) | st.floats(2.5e5, 5e6))
    recording = Recording(
        sample_rate_hz=rate_hz, n_samples=draw(st.integers(1, 300) | st.integers(1, max(1, int(4e-3 * rate_hz))))
    )
    step, divisor = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    head, count = draw(st.sampled_from(["2d", "3d"])), draw(st.integers(1, 40))
    reach_m = 340.0 * recording.duration_s / 2
    array = draw(arrays())
    tuning = draw(some_of(TUNING))
    # Limit the samples of all phases and microphones in the 10 ms that an image needs, to keep examples fast.
    finest = max(1, min(64, int(MAX_SAMPLES * step * divisor / (10e-3 * rate_hz * count_of(array)))))
    tuning["oversampling"] = min(finest, tuning.get("oversampling", finest))
    air = Air(
        temperature_c=draw(st.floats(-40, 60)),
        humidity_percent=draw(st.floats(0, 100)),
        pressure_pa=draw(st.floats(1e4, 2e5)),
    )
    processing = {
        "method": draw(st.sampled_from(["fast", "fast", "fast", "paper"])),
        "directions": f"{head}:{count}",
        "azimuth_limits_deg": draw(limits(-180, 180)),
        "elevation_limits_deg": draw(limits(-90, 90)),
        "range_m": draw(limits(0, reach_m) | limits(0, 1.2 * reach_m)),
        "range_decimation": step * divisor,
        "decimation": draw(st.sampled_from([None, divisor])),
        **draw(some_of(COMBINING)),
    }
    call = draw(calls())
    try:
        call = Call(**call)
        made = Settings(array=array, call=call, recording=recording, air=air, processing=Processing(**processing))
        return tuned(made, **tuning)
    except ArgumentError as error:
        require_one_line(error)
        return None


def require_one_line(error):
    """Require an error message of one line with a remedy."""
    message = str(error)
    assert message
    assert "\n" not in message
    assert ";" in message


def words_for(pipeline, kind, seed):
    """Data of the given kind in the shape that the settings require."""
    random = np.random.default_rng(seed)
    array = pipeline.settings.array
    n_words = -(-count_of(array) // array.word_bits)
    dtype = np.dtype(f"u{array.word_bits // 8}")
    shape = (pipeline.settings.recording.n_samples, n_words)
    words = random.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)
    if kind in {"zeros", "ones"}:
        words[:] = 0 if kind == "zeros" else np.iinfo(dtype).max
    elif kind == "alternating":
        words[0::2], words[1::2] = 0, np.iinfo(dtype).max
    elif kind == "sparse":
        words[random.random(shape) < 0.99] = 0
    elif kind == "stuck":
        words |= dtype.type(1)
    return words if n_words > 1 else words[:, 0]


@pytest.mark.filterwarnings("error")
@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],  # shrinking a failing example takes minutes
)
@given(
    made=any_settings(), kind=st.sampled_from(DATA), seed=st.integers(0, 99), device=st.sampled_from(["cpu", "numpy"])
)
def test_any_settings_and_data_give_an_image_or_one_line(made, kind, seed, device):
    if made is None:
        event("refused when made")
        return
    try:
        pipeline = Pipeline(made, device=device, threads=1, predict=False)
    except (ArgumentError, DataError, DeviceError) as error:  # the device has no 16-bit dot product
        event("refused by the pipeline")
        require_one_line(error)
        return
    event(f"an image of {kind}")
    image = pipeline.process(Measurement(words_for(pipeline, kind, seed), made))
    assert image.amplitude.shape == (len(pipeline.grid), len(pipeline.range_m))
    assert np.isfinite(image.amplitude).all()
    if made.processing.method == "fast" or device == "cpu":  # the paper's recursive low pass undershoots
        assert image.amplitude.min() >= 0
    if made.processing.beamformer == "delay_and_sum":
        assert image.amplitude.max() < LOUDEST / min(made.array.gain or (1.0,))
    for peak in find_peaks(image, top=3):
        assert np.isfinite([peak.range_m, peak.level_db]).all()
        assert np.isfinite(peak.azimuth_deg) or not observable_angles(made.array).azimuth
        assert np.isfinite(peak.elevation_deg) or not observable_angles(made.array).elevation
        assert peak.level_db <= 0
        assert not min(peak.range_sd_m, peak.angle_sd_deg, peak.level_sd_db) < 0


# ---- errors found by random search -----------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_echo_at_range_zero_has_an_uncertain_direction():
    """The uncertainty across it is 0 m, but that of the angle is not 0 / 0."""
    processing = Processing(directions="2d:19", range_m=(0.0, 0.0))
    settings = Settings(recording=Recording(n_samples=40_960), processing=processing)
    pipeline = Pipeline(settings, predict=False)
    image = pipeline.process(Measurement(words_for(pipeline, "noise", 23), settings))
    assert image.range_m.tolist() == [0.0]
    found = find_peaks(image, false_alarm=None)
    assert len(found) >= 1
    assert min(peak.angle_sd_deg for peak in found) > 5  # degrees: echoes of noise
    assert min(peak.range_sd_m for peak in found) > 0


def test_call_shorter_than_a_period_is_refused():
    """Sampled at the signal rate such a call is all zeros, and the matched filter would divide by its power."""
    with pytest.raises(
        ArgumentError, match=r"call\.duration_s is 8e-05, less than a period of 2000 Hz; use 0\.0005 or"
    ):
        Call(start_frequency_hz=2001.0, stop_frequency_hz=2000.0, duration_s=8e-5)


def test_sweep_too_narrow_for_the_paper_is_refused():
    """The band pass of such a sweep rings for a minute, which takes 3 GB to compute."""
    call = Call(start_frequency_hz=40_000.5, stop_frequency_hz=40_000.0)
    Settings(call=call)
    with pytest.raises(
        ArgumentError, match=r"call sweeps over 0\.5 Hz, too little for the band-pass filter .*; use 100 Hz"
    ):
        Settings(call=call, processing=Processing(method="paper"))


def test_peaks_are_found_if_the_sample_rate_cuts_the_band_edge():
    """With the paper's method, the matched filter's band can extend beyond half the signal rate."""
    processing = Processing(method="paper", directions="2d:31", range_decimation=160, decimation=80, range_m=(0.2, 0.5))
    call = Call(start_frequency_hz=25_000.0, stop_frequency_hz=10_000.0)
    made = Settings(call=call, recording=Recording(n_samples=20_000), processing=processing)
    assert made.signal_rate_hz < 2 * (call.high_frequency_hz + 5_000)
    pipeline = Pipeline(made, predict=False)
    [peak] = find_peaks(pipeline.process(Measurement(words_for(pipeline, "noise", 1), made)), top=1, false_alarm=None)
    assert 0.2 < peak.range_m < 0.5
