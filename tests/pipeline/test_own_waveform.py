"""Calls with own waveforms, from files to images."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import wavfile

from ertis_numba.base.errors import ArgumentError, DataError, SettingsError
from ertis_numba.devices.driver import SonarDriver as Driver
from ertis_numba.devices.emulator import Emulator
from ertis_numba.devices.setup import Setup, call_codes
from ertis_numba.frames import Measurement
from ertis_numba.geometry import received_settings
from ertis_numba.geometry.waveform import call_at, call_samples
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import MAX_WAVEFORM_SAMPLES, Call, Processing, Recording, Settings
from ertis_numba.simulation import Point, Scene, Sensor, Sonar, load_scene
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_recording, write_recording

DEFAULT = Call()
SHORT = Call(start_frequency_hz=60e3, stop_frequency_hz=30e3, duration_s=1.5e-3, modulation="linear")
SAMPLES = call_samples(SHORT)
PROCESSING = Processing(directions="2d:31", range_m=(0.4, 1.2))
RECORDING = Recording(n_samples=65_536)


def own(call):
    return Call(waveform=call_samples(call), sample_rate_hz=call.sample_rate_hz)


def image(emitted, matched):
    """Image of a point at 0.8 m and 30° from a sensor that emits one call and matches another."""
    sensor = Sensor(processing=PROCESSING, recording=RECORDING, call=emitted)
    measurement = Simulator(Scene(sensors=(sensor,), points=(Point(range_m=0.8, azimuth_deg=30.0),))).render()
    settings = Settings(processing=PROCESSING, recording=RECORDING, call=matched)
    return Pipeline(settings, device="cpu").process(Measurement(measurement.data, settings, measurement.stamp))


@pytest.fixture(scope="module")
def by_sweep():
    return image(DEFAULT, DEFAULT).amplitude


@pytest.mark.parametrize("emitted", [DEFAULT, own(DEFAULT)])
def test_own_waveform_equal_to_the_default_sweep_gives_the_same_image(emitted, by_sweep):
    change = np.abs(image(emitted, own(DEFAULT)).amplitude - by_sweep).max()
    assert 20 * np.log10(change / by_sweep.max()) < -60


@pytest.mark.parametrize("call", [SHORT, Call(start_frequency_hz=25e3, stop_frequency_hz=50e3)])
def test_own_waveform_images_a_point_at_its_position(call):
    shown = image(own(call), own(call))
    direction, place = np.unravel_index(np.argmax(shown.amplitude), shown.amplitude.shape)
    assert shown.range_m[place] == pytest.approx(0.8, abs=0.002)
    assert np.degrees(shown.azimuth_rad[direction]) == pytest.approx(30.0, abs=3.0)
    assert shown.amplitude.max() == pytest.approx(image(call, call).amplitude.max(), rel=0.01)


def test_matched_filter_takes_its_band_from_the_spectrum():
    call = own(SHORT)
    assert (call.start_frequency_hz, call.stop_frequency_hz) == pytest.approx((62_600, 27_400), abs=200)
    rising = Call(waveform=SAMPLES[::-1])
    assert rising.start_frequency_hz < rising.stop_frequency_hz
    assert call.duration_s == pytest.approx(1.5e-3)


def test_own_waveform_is_interpolated_between_its_samples():
    time_s = np.arange(0, 8000) / 4.5e6
    assert_allclose(call_at(own(SHORT), time_s), call_at(SHORT, time_s), atol=2e-5)


def test_own_waveform_is_scaled_to_a_peak_of_one():
    assert_allclose(call_samples(Call(waveform=0.01 * SAMPLES)), SAMPLES / np.abs(SAMPLES).max(), atol=1e-7)


def wav(path):
    wavfile.write(path, 192_000, np.round(20_000 * call_samples(SHORT, rate_hz=192_000)).astype(np.int16))


def csv(path):
    path.write_text("# own call\n" + "\n".join(f"{sample:.9f}" for sample in SAMPLES), encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "write", "rate_hz"),
    [("own.wav", wav, 192_000), ("own.csv", csv, 450_000), ("own.npy", lambda path: np.save(path, SAMPLES), 450_000)],
)
def test_settings_read_the_waveform_file_beside_them(tmp_path, name, write, rate_hz):
    write(tmp_path / name)
    (tmp_path / "mine.toml").write_text(f'[call]\nwaveform = "{name}"\n', encoding="utf-8")
    call = Settings.load(tmp_path / "mine.toml").call
    assert call == Call.from_file(tmp_path / name)
    assert call.sample_rate_hz == rate_hz
    time_s = np.linspace(0.0, 1.4e-3, 500)
    assert_allclose(call_at(call, time_s), call_at(SHORT, time_s), atol=0.01)
    assert Settings().updated_from_file(tmp_path / "mine.toml").call == call
    back = Settings(call=call).updated_from_file(_file(tmp_path / "sweep.toml", "[call]\nduration_s = 2e-3\n"))
    assert back.call == Call(duration_s=2e-3)


def _file(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_scene_reads_waveforms_of_sensors_and_sonars(tmp_path):
    np.save(tmp_path / "own.npy", SAMPLES)
    text = '[[sensors]]\ncall.waveform = "own.npy"\n[[sonars]]\nrange_m = 2.0\ncall.waveform = "own.npy"\n'
    scene = load_scene(_file(tmp_path / "scene.toml", text))
    assert scene.sensors[0].call == scene.sonars[0].call == Call(waveform=SAMPLES)
    assert isinstance(scene.sonars[0], Sonar)


def test_recording_contains_the_waveform(tmp_path):
    np.save(tmp_path / "own.npy", SAMPLES)
    settings = Settings.load(_file(tmp_path / "mine.toml", 'call.waveform = "own.npy"\nrecording.n_samples = 65536'))
    words = np.zeros(65_536, np.uint32)
    stamp = Simulator(Scene()).render().stamp
    target = write_recording(tmp_path / "rec.h5", [Measurement(words, settings, stamp)])
    (tmp_path / "own.npy").unlink()
    with open_recording(target) as recording:
        assert recording.settings.call == Call(waveform=SAMPLES)
        assert_allclose(call_samples(recording.settings.call), SAMPLES / np.abs(SAMPLES).max(), atol=1e-7)


def test_command_simulates_with_an_own_waveform(tmp_path):
    wav(tmp_path / "own.wav")
    text = '[[sensors]]\ncall.waveform = "own.wav"\nrecording.n_samples = 65536\nprocessing.range_m = [0.4, 1.2]\n'
    path = _file(tmp_path / "scene.toml", f"{text}[[points]]\nrange_m = 0.8\n")
    done = CliRunner().invoke(cli, ["simulate", str(path)])
    assert done.exit_code == 0, done.stderr
    with open_recording(tmp_path / "scene.h5") as recording:
        assert recording.settings.call.sample_rate_hz == 192_000


def test_emulated_sensor_receives_the_own_waveform(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    setup = Setup.of(Settings(call=own(SHORT), recording=RECORDING))
    assert_allclose(setup.codes.astype(int), call_codes(SHORT), atol=1)  # seven decimals may cross a step
    with Emulator([np.zeros(65_536, np.uint32)], link=tmp_path / "left") as device, Driver.open("left") as driver:
        driver.configure(setup)
        assert_array_equal(device.registers.codes[: device.registers.n_codes], setup.codes)
        assert device.registers.dac_rate_hz == 450_000


def test_files_named_in_received_settings_are_not_opened(tmp_path):
    np.save(tmp_path / "own.npy", SAMPLES)
    text = f'call.waveform = "{tmp_path / "own.npy"}"'
    with pytest.raises(SettingsError, match=r"call\.waveform is .*, the name of a file; send its samples instead"):
        received_settings(text, "settings of sensor left")
    kept = received_settings(Settings(call=own(SHORT)).to_toml(), "settings of sensor left")
    assert kept.call == own(SHORT)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_frequency_hz": 80e3}, "call.waveform and call.start_frequency_hz contradict each other"),
        ({"duration_s": 1e-3}, "call.waveform and call.duration_s contradict each other"),
        ({"ramp_fraction": 0.2}, "call.waveform and call.ramp_fraction contradict each other"),
        ({"modulation": "linear"}, "call.waveform and call.modulation are both given"),
        ({"waveform": (0.0, 1.0)}, "call.waveform has 2 samples; use 17 to 4096, at 450000 Hz 9.1 ms at most"),
        ({"waveform": np.ones(MAX_WAVEFORM_SAMPLES + 1)}, "call.waveform has 4097 samples"),
        ({"waveform": np.zeros(100)}, "call.waveform contains only 0"),
        ({"waveform": (*SAMPLES, np.nan)}, "call.waveform holds nan"),
        ({"waveform": SAMPLES + 1.0}, "band that reaches 0 Hz; subtract its mean"),
        ({"sample_rate_hz": -1.0}, "call.sample_rate_hz is -1"),
        ({"waveform": np.resize((1.0, -1.0), 200)}, "band that reaches half of its sample rate of 450000 Hz"),
        ({"waveform": [["a"]]}, r"call.waveform\[0\] is|call.waveform is"),
    ],
)
def test_call_refuses_invalid_waveforms(changes, message):
    with pytest.raises(ArgumentError, match=message):
        Call(**{"waveform": SAMPLES, **changes})


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("own.wav", lambda path: wavfile.write(path, 192_000, np.ones((300, 2), np.int16)), "use one channel"),
        ("own.wav", lambda path: path.write_bytes(b"RIFF"), "is a RIFF file of another form than WAVE"),
        ("own.npy", lambda path: path.write_bytes(b"\x80\x04N."), "cannot be read"),
        ("own.npy", lambda path: path.write_bytes(b""), "cannot be read"),
        ("own.csv", lambda path: path.write_text("a,b"), "cannot be read"),
        ("own.npy", lambda path: np.save(path, np.zeros(2**20)), "the limit is 4194304"),
        ("own.wav", lambda path: path.mkdir(), "no such file"),
        ("own.mp3", lambda path: path.write_bytes(b""), "choose a .wav, .csv or .npy file"),
        ("own.npy", lambda path: np.save(path, np.zeros(100)), "call.waveform contains only 0"),
    ],
)
def test_settings_refuse_invalid_waveform_files(tmp_path, name, write, message):
    write(tmp_path / name)
    path = _file(tmp_path / "mine.toml", f'[call]\nwaveform = "{name}"\n')
    with pytest.raises((SettingsError, DataError), match=re.escape(message)):
        Settings.load(path)


def test_wav_of_another_rate_is_refused(tmp_path):
    wav(tmp_path / "own.wav")
    with pytest.raises(SettingsError, match=r"sample_rate_hz is 96000, but .* has 192000 Hz; leave out"):
        Call.from_file(tmp_path / "own.wav", sample_rate_hz=96_000)


def test_settings_with_an_unread_waveform_are_refused():
    with pytest.raises(ArgumentError, match=r"the file 'own\.wav', which has not been read; use Call\.from_file"):
        Pipeline(Settings(call=Call(waveform="own.wav")), device="cpu")
