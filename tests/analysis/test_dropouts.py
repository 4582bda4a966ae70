"""Dropouts, copies and clipping are named in noise and sound, and never in clean or quiet records."""

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.analysis.health import health
from ertis_numba.analysis.sample_faults import SampleFaults, _still_parts, constant_parts, dropouts
from ertis_numba.analysis.sound_checks import SoundChecks
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import Array, Call, Passive, Processing, Recording, Settings
from ertis_numba.storage import RecordingWriter
from ertis_numba.storage.verify import verify

RATE_HZ, N_SAMPLES, N_MICS, SPEED_M_S = 192e3, 3_000, 8, 343.87
PLACES_M = np.random.default_rng(5).uniform(-0.025, 0.025, (N_MICS, 2)) @ np.eye(2, 3, 1)
SETTINGS = Settings(
    array=Array(layout="drawn", positions_m=tuple(map(tuple, PLACES_M.tolist()))),
    call=Call(start_frequency_hz=50e3, stop_frequency_hz=25e3, duration_s=2.5e-3),
    recording=Recording(sample_rate_hz=RATE_HZ, n_samples=N_SAMPLES, encoding="int16"),
    processing=Processing(directions="2d:91", range_m=(0.5, 2.0)),
)


def call(time_s, ramp=0.1):
    """A hyperbolic sweep from 50 to 25 kHz in 2.5 ms under Hann ramps, or none."""
    inside = np.clip(time_s, 0, 2.5e-3)
    slope = (1 / 25e3 - 1 / 50e3) / 2.5e-3
    edge = np.minimum(inside, 2.5e-3 - inside) / (ramp * 2.5e-3) if ramp else np.ones_like(inside)
    window = np.sin(np.pi / 2 * np.minimum(edge, 1)) ** 2
    return np.where(inside == time_s, np.sin(2 * np.pi / slope * np.log1p(slope * 50e3 * inside)) * window, 0.0)


def rendered(seed=0, *, noise=1e-3, gain=1.0, ramp=0.1, echoes=((1.2, 20.0, 0.1), (1.7, -30.0, 0.05))):
    """Samples (sample, mic) of reflectors at ranges and azimuths, relative to full scale."""
    time_s = np.arange(N_SAMPLES) / RATE_HZ
    signals = noise * np.random.default_rng(seed).standard_normal((N_SAMPLES, N_MICS))
    for range_m, azimuth_deg, amplitude in echoes:
        place_m = range_m * np.array([np.cos(np.radians(azimuth_deg)), np.sin(np.radians(azimuth_deg)), 0])
        paths_m = range_m + np.linalg.norm(place_m - PLACES_M, axis=1)
        signals += amplitude * call(time_s[:, None] - paths_m / SPEED_M_S, ramp)
    return gain * signals


def measured(signals, **stamp):
    """A measurement of 16-bit samples."""
    data = np.clip(np.rint(32_767 * signals), -32_768, 32_767).astype("<i2")
    return ertis.Measurement(data, SETTINGS, ertis.Stamp(sensor="s", **stamp))


def cut(signals, first, stop, value=0.0):
    signals = signals.copy()
    signals[first:stop] = value
    return signals


@pytest.mark.parametrize(("first", "stop"), [(1500, 2000), (2300, 2600), (600, 1200), (1500, 1540), (100, 2900)])
def test_dropouts_are_named_and_leave_the_noise_floor(first, stop):
    """White noise of 1e-3 has 25/96 of its power in the band of the call."""
    report = health(measured(cut(rendered(), first, stop)))
    (found,) = report.record_faults
    assert (found.fault, found.measured) == ("dropout", stop - first)
    assert found.detail == f"samples {first}-{stop - 1} have one value in every channel"
    if stop - first < 2000:
        assert report.noise_dbfs == pytest.approx(10 * np.log10(1e-6 * 25 / 96), abs=1.0)
    else:
        assert report.noise_dbfs is None


def test_dropouts_may_hold_a_value_and_occur_often():
    signals = rendered(1)
    signals[700:800], signals[1900:2000] = signals[700], signals[1900]
    assert dropouts(measured(signals)) == [(700, 800), (1900, 2000)]


@pytest.mark.parametrize(
    "signals",
    [
        rendered(),
        rendered(noise=0),
        rendered(noise=0, ramp=0),
        rendered(noise=1e-5),
        rendered(noise=0, gain=0.003),
        cut(cut(rendered(), 0, 700), 2500, 3000),
        rendered(echoes=()),
        np.rint(3 * np.sin(2 * np.pi * 50 * np.arange(N_SAMPLES) / RATE_HZ))[:, None] * np.ones(N_MICS) / 32_767,
        1.2 * np.sin(2 * np.pi * 500 * np.arange(N_SAMPLES) / RATE_HZ)[:, None] * np.ones(N_MICS),
        np.zeros((N_SAMPLES, N_MICS)),
    ],
    ids=["noise", "clean", "clean without ramps", "less than a step", "weak", "trigger", "silence", "hum", "loud", "0"],
)
def test_right_records_have_no_dropouts(signals):
    assert dropouts(measured(signals)) == []


def test_channels_that_are_stuck_together_are_named():
    signals = rendered()
    signals[1500:2000, :4] = 0
    assert health(measured(signals)).faults == {"stuck at times": (0, 1, 2, 3)}


@pytest.mark.parametrize("limit", [0.3, 0.05])
def test_clipping_below_full_scale_is_named_with_its_level(limit):
    report = health(measured(np.clip(rendered(gain=400 * limit), -limit, 0.9 * limit)))
    assert report.faults == {"saturated": tuple(range(N_MICS))}
    assert [item.clip_dbfs for item in report.channels] == pytest.approx(N_MICS * [20 * np.log10(0.9 * limit)], abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_unclipped_signals_are_not_saturated(seed):
    time_s = np.arange(N_SAMPLES) / RATE_HZ
    tone = 0.3 * np.sin(2 * np.pi * (30e3 + 1e3 * seed) * time_s)[:, None] * np.ones(N_MICS)
    for signals in (rendered(seed, gain=8), tone, tone + rendered(seed), rendered(seed, noise=1e-4), 1e-3 * tone):
        assert "saturated" not in health(measured(signals)).faults


def test_maps_leave_out_dropouts_without_phantom_sources():
    """A cut of loud sound is heard in every band; blocks without it show one source."""
    settings = SETTINGS.replace(
        recording=SETTINGS.recording.replace(n_samples=9_600),
        processing=SETTINGS.processing.replace(directions="3d:1000"),
        passive=Passive(bands_hz=((20e3, 25e3), (25e3, 40e3), (40e3, 60e3))),
    )
    random, n_fft = np.random.default_rng(3), 16_384
    spectrum, frequency_hz = np.fft.rfft(random.standard_normal(n_fft)), np.fft.rfftfreq(n_fft, 1 / RATE_HZ)
    spectrum[(frequency_hz < 26e3) | (frequency_hz > 39e3)] = 0
    direction = np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0])
    late_s = -PLACES_M @ direction / SPEED_M_S
    turned = spectrum[:, None] * np.exp(-2j * np.pi * frequency_hz[:, None] * late_s)
    sound = 0.1 * np.fft.irfft(turned, n_fft, axis=0)[4_000:13_600] + 3e-4 * random.standard_normal((9_600, N_MICS))
    stamp, bearings = ertis.Stamp(sensor="s", behaviour="passive"), {}
    with ertis.AcousticCamera(settings, check=False, false_alarm=1e-3, threads=1) as camera:
        for name, signals in (("whole", sound), ("cut", cut(sound, 3_000, 6_000))):
            data = np.rint(32_767 * signals).astype("<i2")
            found = camera.process(ertis.Measurement(data, settings, stamp))
            bearings[name], n_blocks = found.bearings, found.n_blocks
    assert [len(each) for each in bearings.values()] == [1, 1]
    assert np.degrees(bearings["cut"][0].azimuth_rad) == pytest.approx(20, abs=0.2)
    assert n_blocks * 96 < 6_600


def test_copies_of_measurements_are_counted():
    faults = SampleFaults()
    for seed in (0, 1, 1, 1, 2):
        faults.add(measured(rendered(seed)))
    assert faults.note() == (
        "2 of 5 measurements are copies of the one before in every sample, which recorded sound never is; check the "
        "link to the sensor, and record again"
    )
    silent = SampleFaults()
    for _ in range(3):
        silent.add(measured(np.zeros((N_SAMPLES, N_MICS))))
    assert not silent.note()


def test_sound_checks_report_a_dropout_once_and_copies_of_live_measurements():
    lost, intact = measured(cut(rendered(), 1500, 2000)), measured(rendered())
    checks = SoundChecks()
    found = [[each.subject for each in checks.check(measurement)] for measurement in (intact, intact, lost, lost)]
    assert [each.count("samples") for each in found] == [0, 0, 1, 0]
    live = SoundChecks(live=True)
    found = [[each.subject for each in live.check(measurement)] for measurement in (intact, intact, intact)]
    assert [each.count("samples") for each in found] == [0, 1, 0]


def test_frozen_recordings_are_named_by_every_command(tmp_path):
    path = tmp_path / "a.h5"
    with RecordingWriter(path) as writer:
        for number, seed in enumerate((0, 0, 0, 1)):
            stamp = {"sequence": number, "sync_count": number, "timestamp_ns": 10**18 + number * 10**8}
            writer.write(measured(rendered(seed), behaviour="active", **stamp))
    (report,) = verify(path)
    assert (report.copies, report.is_intact) == ((1, 2), True)
    invoke = CliRunner().invoke
    assert "4 measurements, 2 copies of the measurement before (at 1 to 2)" in invoke(cli, ["verify", str(path)]).output
    (sensor,) = check_recording(path).sensors
    assert "2 of 4 measurements are copies of the one before in every sample" in sensor.faults[0].text
    done = invoke(cli, ["process", str(path), "-o", str(tmp_path / "b.h5"), "--threads", "1"])
    assert "sensor s: 2 of 4 measurements are copies of the one before" in done.output
    assert "2 of 4 measurements are copies" in invoke(cli, ["peaks", str(tmp_path / "b.h5")]).output


def test_odometry_of_frozen_images_is_unknown():
    odometry = ertis.Odometry({"s": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}, alone=True)
    with ertis.Pipeline(SETTINGS, threads=1, predict=False) as pipeline:
        images = [pipeline.process(measured(rendered(seed))) for seed in (0, 0, 0, 1)]
    for number, image in enumerate(images):
        stamp = ertis.Stamp(sensor="s", sync_count=number, timestamp_ns=10**18 + number * 10**8, behaviour="active")
        assert odometry.add([image.replace(stamp=stamp)]) is None
    assert [pose.doubt for pose in odometry.poses] == ["", "copies", "copies", "few echoes"]
    assert odometry.poses[-1].covariance[0, 0] > 0.01**2


@pytest.mark.parametrize("first", [0, 65_400, 65_535, 65_536, 65_537, 131_000])
def test_still_parts_across_pieces_are_those_of_the_whole_record(first):
    rows = np.random.default_rng(first).integers(1, 9, (140_000, 2)).astype(np.int16)
    rows[first : first + 300] = 0
    changes = np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1))
    assert _still_parts(rows, 100) == ([(first, first + 300)], len(changes))


def drawn(rng, kind, n_mics):
    """Sound of one kind, by its own generator and not by the simulator, at 16 bits, 24 bits or single precision."""
    signals, level = rng.standard_normal((N_SAMPLES, n_mics)), 10 ** (rng.uniform(-85, -20) / 20)
    if kind == "low-pass noise":
        keep = np.arange(N_SAMPLES // 2 + 1)[:, None] < rng.uniform(0.02, 0.5) * N_SAMPLES / 2
        signals = np.fft.irfft(np.fft.rfft(signals, axis=0) * keep, axis=0)
        signals /= signals.std()
    elif kind == "tone":
        rad = 2 * np.pi * rng.uniform(0.001, 0.4) * np.arange(N_SAMPLES)[:, None] + rng.uniform(0, 6.28, n_mics)
        signals = 0.01 * signals + np.sin(rad)
    elif kind == "clipped noise":
        signals, level = np.clip(rng.uniform(0.5, 20) * signals, -1, 1), 1.0
    return scaled(signals * level, rng.choice([15, 23, 0]))


def scaled(signals, bits):
    """Integers of a number of bits behind the sign, or floating point for 0."""
    if not bits:
        return signals.astype(np.float32)
    return np.clip(np.round(signals * 2**bits), -(2**bits), 2**bits - 1).astype(np.int32)


@pytest.mark.parametrize("kind", ["white noise", "low-pass noise", "tone", "clipped noise"])
def test_dropouts_of_drawn_sound_are_found_where_they_are_and_nowhere_else(kind):
    rng, n_found, n_draws = np.random.default_rng(4711), 0, 150
    for _ in range(n_draws):
        signals = drawn(rng, kind, n_mics := int(rng.choice([1, 4, 8])))
        assert constant_parts(signals, np.arange(n_mics), is_pdm=False) == []
        first, length = int(rng.integers(100, N_SAMPLES - 1600)), int(np.exp(rng.uniform(np.log(36), np.log(1500))))
        found = constant_parts(cut(signals, first, first + length), np.arange(n_mics), is_pdm=False)
        n_found += any(abs(a - first) <= 4 and abs(b - first - length) <= 4 for a, b in found)
    # A dropout that begins where nothing changes, as in clipped sound, cannot be told from the sound.
    assert n_found >= (0.3 if kind == "clipped noise" else 0.92) * n_draws
