"""Import with a loopback channel. The truth is a call of closed form at times between the samples."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.io import wavfile

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Call, Settings
from tests.rings import PCM, RATE_HZ

SETTINGS = Settings(array=PCM.array).replace("processing.directions", "2d:31")
SPEED_M_S = sound_speed_m_s(SETTINGS.air)
START_HZ, STOP_HZ, CALL_S = 50e3, 25e3, 2.5e-3


def call(time_s):
    """The default call: a hyperbolic sweep with ramps of a tenth of its duration."""
    inside = (time_s >= 0) & (time_s <= CALL_S)
    slowness = (1 / STOP_HZ - 1 / START_HZ) / CALL_S
    phase_rad = 2 * np.pi / slowness * np.log1p(START_HZ * slowness * np.where(inside, time_s, 0))
    edge_s = np.minimum(time_s, CALL_S - time_s).clip(0, CALL_S / 10)
    return np.where(inside, np.sin(phase_rad) * np.sin(np.pi / 2 * edge_s / (CALL_S / 10)) ** 2, 0)


def trigger(time_s):
    """A pulse of 1 ms whose edges take 20 µs."""
    return np.clip(time_s / 20e-6 + 0.5, 0, 1) * np.clip((1e-3 - time_s) / 20e-6 + 0.5, 0, 1)


def record(emissions_s, duration_s, *, range_m=1.2, loopback=call, gain=0.5, noise=1e-4, rate_hz=RATE_HZ, channel=8):
    """Signals of eight microphones and of a loopback, in which a point ahead reflects each emission."""
    time_s = np.arange(round(duration_s * rate_hz)) / rate_hz
    random = np.random.default_rng(5)
    place_m = np.array([range_m, 0.0, 0.0])
    paths_m = range_m + np.linalg.norm(np.array(PCM.array.positions_m) - place_m, axis=1)
    echoes = [sum(0.05 * call(time_s - at_s - path_m / SPEED_M_S) for at_s in emissions_s) for path_m in paths_m]
    sync = sum(gain * loopback(time_s - at_s) for at_s in emissions_s) + np.zeros(len(time_s))
    signals = np.stack([*echoes[:channel], sync, *echoes[channel:]], axis=1)
    return signals + noise * random.standard_normal(signals.shape)


def write(path, signals, rate_hz=RATE_HZ, kind="f4"):
    wavfile.write(path, rate_hz, signals.astype(kind) if kind == "f4" else np.rint(32_767 * signals).astype(kind))
    return path


def ranges_m(reader):
    with Pipeline(reader.settings, device="numpy", predict=False) as pipeline:
        return [ertis.find_peaks(pipeline.process(each), top=1)[0].range_m for each in reader]


CASES = {
    "1.37 ms": ([1.37e-3], 0.02, {}),
    "at the first sample": ([0.0], 0.02, {}),
    "between samples": ([3.2217e-3], 0.02, {}),
    "16 bits": ([1.3713e-3], 0.02, {"kind": "<i2"}),
    "first channel": ([1.37e-3], 0.02, {"channel": 0}),
    "inverted": ([1.37e-3], 0.02, {"gain": -0.5}),
    "weak": ([1.37e-3], 0.02, {"gain": 2e-3}),
    "noisy": ([1.37e-3], 0.02, {"gain": 0.05, "noise": 0.02, "range_m": None}),
    "inverted trigger": ([1.37e-3], 0.02, {"loopback": trigger, "gain": -0.3}),
    "jitter": ([1.37e-3, 31.912e-3, 60.7771e-3, 92.003e-3], 0.12, {}),
    "drift": ([1e-3 + 0.03 * (1 + 2e-4) * number for number in range(4)], 0.14, {}),
    "several triggers": ([1.37e-3, 31.912e-3, 60.7771e-3], 0.1, {"loopback": trigger}),
    "other rate": ([1.37e-3, 31.9e-3], 0.07, {"rate_hz": 125_000}),
    "high rate": ([1.37e-3, 31.9e-3], 0.07, {"rate_hz": 500_000}),
}


@pytest.mark.parametrize("name", CASES)
def test_emissions_in_a_loopback_set_the_ranges(tmp_path, name):
    emissions_s, duration_s, given = CASES[name]
    options = {"rate_hz": RATE_HZ, "channel": 8} | given
    kind = options.pop("kind", "f4")
    range_m = options.pop("range_m", 1.2)
    path = write(tmp_path / "a.wav", record(emissions_s, duration_s, **options), options["rate_hz"], kind)
    reader = ertis.open_pcm(path, SETTINGS, sync_channel=options["channel"])
    measurements = list(reader)
    assert len(measurements) == len(emissions_s)
    assert measurements[0].data.shape[1] == 8
    found_s = np.array([each.stamp.timestamp_ns for each in measurements]) / 1e9
    accuracy = 0.1 if options.get("loopback") is not trigger else 2.5
    assert found_s - found_s[0] == pytest.approx(
        np.array(emissions_s) - emissions_s[0], abs=2 * accuracy / options["rate_hz"]
    )
    if range_m:
        assert ranges_m(reader) == pytest.approx([range_m] * len(emissions_s), abs=2e-3)


def test_noise_of_a_narrow_band_is_no_emission(tmp_path):
    tone = SETTINGS.replace("call", Call(start_frequency_hz=40_500.0, stop_frequency_hz=39_500.0, duration_s=1e-3))
    noise = np.random.default_rng(2).normal(0, 0.1, (40_000, 9))
    with pytest.raises(DataError, match=r"channel 8 contains no emission"):
        ertis.open_pcm(write(tmp_path / "a.wav", noise), tone, sync_channel=8)


def test_doubtful_loopbacks_are_noted(tmp_path):
    """Another sweep than that of the settings, and a sweep in the opposite direction."""

    def linear(time_s):
        inside = (time_s >= 0) & (time_s <= CALL_S)
        return np.where(inside, np.sin(2 * np.pi * (START_HZ * time_s - 5e6 * time_s**2)), 0)

    path = write(tmp_path / "a.wav", record([1e-3], 0.02, loopback=linear))
    notes = " ".join(ertis.open_pcm(path, SETTINGS, sync_channel=8).notes)
    assert "the call in channel 8 matches that of the settings poorly (correlation 0." in notes
    path = write(tmp_path / "b.wav", record([1e-3], 0.02, loopback=lambda time_s: call(CALL_S - time_s)))
    notes = " ".join(ertis.open_pcm(path, SETTINGS, sync_channel=8).notes)
    assert "emissions are assumed at the onsets of its pulses, which rise in 1.8e+02 µs" in notes


@pytest.mark.parametrize("channel", [0, 8])
def test_channel_of_a_microphone_is_noted(tmp_path, channel):
    path = write(tmp_path / "a.wav", record([3e-3, 33e-3], 0.06))
    notes = " ".join(ertis.open_pcm(path, SETTINGS, sync_channel=channel).notes)
    expected = r"channel 8 contains the call 6\.9\d ms before channel 0, and louder; use sync_channel=8"
    assert bool(re.search(expected, notes)) == (channel == 0)


def test_late_echo_before_the_first_emission_is_no_loopback(tmp_path):
    path = write(tmp_path / "a.wav", record([-5e-3, 25e-3, 55e-3], 0.09, gain=0.02))
    assert "louder" not in " ".join(ertis.open_pcm(path, SETTINGS, sync_channel=8).notes)


def test_notes_state_the_emissions(tmp_path):
    path = write(tmp_path / "a.wav", record(*CASES["jitter"][:2]))
    notes = " ".join(ertis.open_pcm(path, SETTINGS, sync_channel=8).notes)
    assert "4 emissions found in channel 8, which is not imported, 0.028865" in notes
    assert "s apart; rounding to samples changes ranges by up to 0." in notes
    assert "first sample" not in notes


def test_record_before_the_emission_gives_wrong_ranges_without_the_loopback(tmp_path):
    """The case that the loopback corrects, and its note."""
    path = write(tmp_path / "a.wav", record([1.37e-3], 0.02)[:, :8])
    reader = ertis.open_pcm(path, SETTINGS)
    assert ranges_m(reader) == pytest.approx([1.2 + 1.37e-3 * SPEED_M_S / 2], abs=2e-3)
    assert any("is assumed at the first sample of each file" in note for note in reader.notes)
    reader = ertis.open_pcm(path, SETTINGS, skip_s=0.00137)
    assert ranges_m(reader) == pytest.approx([1.2], abs=2e-3)
    assert any("is assumed 0.00137 s after the start of each file" in note for note in reader.notes)


def test_emission_before_the_first_sample_is_left_out(tmp_path):
    path = write(tmp_path / "a.wav", record([-1.1e-3, 30e-3, 60e-3], 0.09))
    reader = ertis.open_pcm(path, SETTINGS, sync_channel=8)
    assert len(reader) == 2
    assert ranges_m(reader) == pytest.approx([1.2, 1.2], abs=2e-3)
    assert any("an emission that began before the first sample was left out" in note for note in reader.notes)


def test_emission_whose_record_is_cut_off_is_left_out(tmp_path):
    path = write(tmp_path / "a.wav", record([1e-3, 31e-3, 61e-3], 0.08))
    reader = ertis.open_pcm(path, SETTINGS, sync_channel=8)
    assert len(reader) == 2
    assert "emissions left out because their file ends too early: 1" in reader.notes


def test_missing_emission_is_noted(tmp_path):
    emissions_s = [1e-3 + 0.03 * number for number in (0, 1, 2, 4, 5)]
    reader = ertis.open_pcm(write(tmp_path / "a.wav", record(emissions_s, 0.19)), SETTINGS, sync_channel=8)
    assert len(reader) == 5
    assert any(
        "the emissions at 0.061 s and 0.121 s are 2 times as far apart as usual" in note for note in reader.notes
    )


def test_length_shortens_measurements(tmp_path):
    path = write(tmp_path / "a.wav", record([1e-3, 31e-3], 0.07))
    reader = ertis.open_pcm(path, SETTINGS, sync_channel=8, length_s=0.02)
    assert reader.settings.recording.n_samples == 3_840


def test_files_are_cut_at_their_own_emissions(tmp_path):
    paths = [
        write(tmp_path / f"{number}.wav", record([late_s], 0.03)) for number, late_s in enumerate((1.37e-3, 4.1e-3))
    ]
    reader = ertis.open_pcm(paths, SETTINGS, sync_channel=8, start_ns=10**18)
    assert ranges_m(reader) == pytest.approx([1.2, 1.2], abs=2e-3)
    times_s = [each.stamp.timestamp_ns / 1e9 - 1e9 for each in reader]
    assert times_s == pytest.approx([0, 0.03 + 4.1e-3 - 1.37e-3], abs=1e-6)


REFUSED = {
    "silence": (
        record([1e-3], 0.02, gain=0.0),
        {},
        DataError,
        r"channel 8 contains no emission: neither the call \(correlation 0\.\d\d\)",
    ),
    "zeros": (record([1e-3], 0.02, gain=0.0, noise=0.0), {}, DataError, r"channel 8 contains no emission"),
    "cut off": (
        record([-1e-3], 0.02),
        {},
        DataError,
        r"the only emission in channel 8 began before the first sample; start the recorder before the emission",
    ),
    "no such channel": (
        record([1e-3], 0.02),
        {"sync_channel": 9},
        ArgumentError,
        r"sync_channel is 9; use a whole number from 0 to 8",
    ),
    "no channel left": (
        record([1e-3], 0.02)[:, 1:],
        {"sync_channel": 7},
        DataError,
        r"has 8 channels, but array 'ring' and sync_channel need 8 \+ 1;",
    ),
    "not finite": (
        np.where(np.arange(9) == 8, np.nan, record([1e-3], 0.02)),
        {},
        DataError,
        r"channel 8 of .* contains NaN or infinity; replace",
    ),
    "skip": (
        record([1e-3], 0.02),
        {"skip_s": 0.001},
        ArgumentError,
        r"skip_s and sync_channel cannot be combined; remove one",
    ),
    "passive": (record([1e-3], 0.02), {"passive": True}, ArgumentError, r"passive=True and sync_channel cannot be"),
    "long": (
        record([1e-3, 31e-3], 0.07),
        {"length_s": 0.05},
        DataError,
        r"is followed by the next one or by the end after 0\.03 s, but length_s is 0\.05; use a shorter",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_loopback_without_complete_emissions_is_refused(tmp_path, name):
    signals, options, error, message = REFUSED[name]
    with pytest.raises(error, match=message):
        ertis.open_pcm(write(tmp_path / "a.wav", signals), SETTINGS, **({"sync_channel": 8} | options))


def test_sync_channel_command_corrects_the_ranges(tmp_path):
    write(tmp_path / "a.wav", record([1.37e-3], 0.02))
    (tmp_path / "ring.toml").write_text(SETTINGS.to_toml())
    arguments = [
        "import",
        "signals",
        str(tmp_path / "a.wav"),
        "--settings",
        str(tmp_path / "ring.toml"),
        "--sync-channel",
        "8",
    ]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.stderr
    assert "note: 1 emission found in channel 8, which is not imported; rounding" in done.stderr
    with ertis.open_recording(tmp_path / "a.h5") as recording:
        assert recording[0].data.shape[1] == 8
