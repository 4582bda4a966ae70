"""Sound of one direction: as loud as its source, and audible."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.base.wav import read_wav
from ertis_numba.geometry import microphones
from ertis_numba.passive import BeamSound, HeardSignals, heterodyned, listen_to, time_expanded
from ertis_numba.passive.wave_delays import WaveDelays
from tests.passive.test_acoustic_camera import settings_of, sound


def tone(frequency_hz, *, rate_hz=225e3, n=22_500):
    return BeamSound(np.sin(2 * np.pi * frequency_hz * np.arange(n) / rate_hz).astype(np.float32), rate_hz)


def loudest_hz(heard):
    inner = heard.samples[len(heard.samples) // 10 : -len(heard.samples) // 10]
    return np.abs(np.fft.rfft(inner * np.hanning(len(inner)))).argmax() * heard.rate_hz / len(inner)


def test_sound_equals_the_mean_of_signals_delayed_in_float64():
    """Compare with the sinc interpolation of each signal."""
    settings = settings_of(recording__n_samples=600, array__delay_s=[1e-6, 0.0, 0.0, -2e-6, 0.0, 0.0])
    measurement = sound(settings, [(20, 0.1)])
    direction = ertis.geometry.unit_vectors(np.radians([20]), np.radians([5]))
    delay_s = WaveDelays(settings)(direction)[0]
    with HeardSignals(settings) as signals:
        rows, found = signals(measurement).astype(float), listen_to(measurement, 20, 5, signals=signals)
    samples = np.arange(rows.shape[1])
    expected = sum(
        row @ np.sinc(samples + delay * found.rate_hz - samples[:, None])
        for row, delay in zip(rows, delay_s, strict=True)
    )
    spectrum, frequency_hz = np.fft.rfft(expected), np.fft.rfftfreq(len(expected), 1 / found.rate_hz)
    expected = np.fft.irfft(np.where(frequency_hz > signals.band_hz[1], 0, spectrum), len(expected))
    inner = slice(50, 250)  # ends depend on what the interpolation assumes beyond them
    assert np.abs(found.samples - expected / 6)[inner].max() < 0.02 * np.abs(expected / 6).max()


def test_source_keeps_its_sound_and_noise_is_weaker():
    settings = settings_of()
    with HeardSignals(settings, highest_hz=90e3) as signals:
        assert signals.rate_hz == 225e3

        def level(sources, azimuth_deg, noise=0.0):
            heard = listen_to(sound(settings, sources, noise=noise), azimuth_deg, signals=signals)
            return np.std(heard.samples)

        assert level([(20, 0.3)], 20) == pytest.approx(0.3, rel=0.03)
        assert level([(20, 0.3)], -40) < 0.2
        assert level([], 20, noise=0.1) == pytest.approx(0.1 / np.sqrt(6), rel=0.03)


def test_heterodyne_shifts_frequencies():
    for frequency_hz, shift_hz in ((40e3, 39e3), (40e3, 43e3), (25e3, 20e3)):
        found = heterodyned(tone(frequency_hz), shift_hz)
        assert found.rate_hz == 48e3
        assert found.duration_s == pytest.approx(0.1, abs=1e-3)
        assert loudest_hz(found) == pytest.approx(abs(frequency_hz - shift_hz), abs=20)
        assert np.std(found.samples[400:-400]) == pytest.approx(np.sqrt(0.5), rel=0.02)
    assert np.std(heterodyned(tone(80e3), 39e3).samples[400:-400]) < 1e-3  # 41 kHz is beyond half of the rate
    assert len(heterodyned(BeamSound(np.zeros(0, np.float32), 225e3), 1e3).samples) == 0


def test_expansion_divides_frequencies():
    found = time_expanded(tone(40e3), 10)
    assert found.duration_s == pytest.approx(1.0)
    assert loudest_hz(found) == pytest.approx(4e3, abs=5)


def test_arguments_outside_their_limits_are_refused():
    measurement = sound(settings_of(), [])
    for words, call in (
        ("azimuth_deg", lambda: listen_to(measurement, 181)),
        ("elevation_deg", lambda: listen_to(measurement, 0, 91)),
        ("measurement", lambda: listen_to(None, 0)),
        ("signals is of type str", lambda: listen_to(measurement, 0, signals="all")),
        ("settings is of type NoneType", lambda: HeardSignals(None)),
        ("shift_hz", lambda: heterodyned(tone(1e3), 2e5)),
        ("rate_hz", lambda: heterodyned(tone(1e3), 1e3, 1e6)),
        ("too low", lambda: heterodyned(tone(1e3, rate_hz=1e9, n=100), 1e3, 1e3)),
        ("factor", lambda: time_expanded(tone(1e3), 0.5)),
        ("sound", lambda: heterodyned(None, 1e3)),
        ("samples", lambda: BeamSound(np.zeros((2, 2), np.float32), 1e3)),
        ("highest_hz", lambda: HeardSignals(settings_of(), highest_hz=1e6)),
    ):
        with pytest.raises(ArgumentError, match=words):
            call()
    with (
        HeardSignals(settings_of(air__temperature_c=30.0)) as signals,
        pytest.raises(DataError, match="measurement has"),
    ):
        listen_to(measurement, 0, signals=signals)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("sound") / "REC.h5"
    settings = settings_of()
    ertis.write_recording(
        path,
        [
            ertis.Measurement(
                sound(settings, [(20, 0.01)], seed=k).data,
                settings,
                ertis.Stamp(sequence=k, timestamp_ns=10**18 + k * 10**8),
            )
            for k in range(3)
        ],
    )
    return path


def run(*arguments):
    return CliRunner().invoke(cli, ["export", *map(str, arguments)])


@pytest.mark.parametrize(
    ("options", "rate_hz", "duration_s"),
    [
        ([], 112_500, 3 * 8192 / 225e3),
        (["--measurement", "1"], 112_500, 8192 / 225e3),
        (["--silence"], 112_500, 0.2 + 8192 / 225e3),
        (["--heterodyne", "35000"], 48_000, 3 * 8192 / 225e3),
        (["--expand", "10"], 11_250, 30 * 8192 / 225e3),
    ],
)
def test_command_writes_sound(recording, tmp_path, options, rate_hz, duration_s):
    target = tmp_path / "SOUND.wav"
    done = run(recording, "-o", target, "--listen", "20,0", "--json", *options)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout[done.stdout.index("{") :])
    wav = read_wav(target)
    found_hz, samples = wav.rate_hz, wav.samples[:]
    assert found_hz == rate_hz == report["rate_hz"]
    assert (
        len(samples) / rate_hz == pytest.approx(duration_s, abs=1e-3) == pytest.approx(report["duration_s"], abs=2e-3)
    )
    assert np.abs(samples).max() == pytest.approx(10 ** (-1 / 20), rel=1e-4)
    assert report["format"] == "wav"
    assert "amplified" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "x.wav"], "--listen AZ,EL"),
        (["-o", "x.wav", "--listen", "20"], "is not a direction"),
        (["-o", "x.wav", "--listen", "0,0", "--top", "3"], "option --top is given, but format 'wav' does not have it"),
        (["-o", "x.wav", "--listen", "0,0", "--expand", "3", "--heterodyne", "3"], "choose one of them"),
        (
            ["-o", "x.npz", "--listen", "0,0"],
            "option --listen is given, but format 'npz' does not have it; leave it out, or write wav",
        ),
    ],
)
def test_command_refuses_impossible_options(recording, arguments, words):
    done = run(recording, *arguments)
    assert done.exit_code == 2
    assert words in done.stderr


def test_command_names_its_option_for_a_shift_above_the_sound(recording, tmp_path):
    done = run(recording, "-o", tmp_path / "x.wav", "--listen", "0,0", "--heterodyne", "4e9")
    assert done.exit_code == 2
    assert "--heterodyne is 4e+09; use a number from 0 to 56250" in done.stderr
    assert not (tmp_path / "x.wav").exists()


@pytest.mark.parametrize("rate_hz", [16e3, 44.1e3, 48e3])
@pytest.mark.parametrize("away", [1.05, 1.2, 1.5, 1.9])
@pytest.mark.parametrize("side", [-1, 1])
def test_tones_beyond_half_of_the_rate_leave_no_aliases(rate_hz, away, side):
    n, source_rate_hz, shift_hz = 45_000, 225e3, 50e3
    time_s = np.arange(n) / source_rate_hz
    swell = np.hanning(n)  # no clicks at its ends
    tone = swell * np.sin(2 * np.pi * (shift_hz + side * away * rate_hz / 2) * time_s)
    found = heterodyned(BeamSound(tone.astype(np.float32), source_rate_hz), shift_hz, rate_hz)
    assert np.sqrt(np.mean(found.samples**2)) < 1e-3 * np.sqrt(np.mean(tone**2))


@pytest.mark.parametrize("frequency_hz", [41e3, 60e3, 100e3])
def test_sound_above_the_highest_frequency_leaves_no_aliases(frequency_hz):
    settings = settings_of(passive__bands_hz=[[20e3, 30e3]])
    recording = settings.recording
    time_s = np.arange(recording.n_samples) / recording.sample_rate_hz
    tone = np.hanning(len(time_s)) * np.sin(2 * np.pi * frequency_hz * time_s)
    n_mics = len(microphones(settings.array).enabled_positions_m)
    data = np.repeat(tone[:, None], n_mics, axis=1).astype(np.float32)
    found = listen_to(ertis.Measurement(data, settings), 0.0)
    assert found.rate_hz < recording.sample_rate_hz
    assert np.sqrt(np.mean(found.samples**2)) < 1e-3 * np.sqrt(np.mean(tone**2))
