"""Call match: recordings made with another call are reported, healthy ones are not."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.error_trials import budgets
from ertis_cli.main import cli
from scipy.signal import chirp

from ertis_numba.analysis.call_match import SILENT, call_match, first_call_match
from ertis_numba.base.errors import CallMismatchWarning
from ertis_numba.frames import Measurement
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Call, Processing, Recording, Settings
from ertis_numba.storage import open_energyscapes, write_recording
from tests.health_recordings import REAL, real

SETTINGS = Settings(
    recording=Recording(sample_rate_hz=450e3, n_samples=8100, encoding="float32"),
    processing=Processing(directions="2d:9", range_m=(0.5, 1.4), range_decimation=10, wavefront="plane"),
)
CALL = SETTINGS.call
REVERSED = CALL.replace(start_frequency_hz=CALL.stop_frequency_hz, stop_frequency_hz=CALL.start_frequency_hz)


def heard(emitted, *, echoes=((6e-3, 1.0),), noise=0.0, seed=0, settings=SETTINGS):
    """Measurement of echoes ``(delay, amplitude)`` of a call that may differ from that of the settings."""
    random = np.random.default_rng(seed)
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    signal = np.zeros(len(time_s))
    for delay_s, amplitude in echoes:
        signal += amplitude * call_at(emitted, time_s - delay_s)
    words = 0.1 * (signal[:, None] + noise * random.standard_normal((len(time_s), 32)))
    return Measurement(words.astype(np.float32), settings)


@pytest.mark.parametrize("modulation", ["hyperbolic", "linear"])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_call_match_finds_sweeps_of_the_opposite_direction(modulation, noise):
    settings = SETTINGS.replace(call=CALL.replace(modulation=modulation))
    found = call_match(heard(REVERSED.replace(modulation=modulation), noise=noise, settings=settings))
    assert found.verdict == "differs"
    assert (found.sweep.modulation, found.sweep.start_hz < found.sweep.stop_hz) == (modulation, True)
    assert found.sweep.duration_s == pytest.approx(CALL.duration_s, rel=0.2)
    assert re.search(rf"{modulation} sweep from about 2\d to", found.warning)
    assert "in the opposite direction" in found.warning


@pytest.mark.parametrize(
    "emitted", [CALL.replace(duration_s=5e-3), CALL.replace(duration_s=1.25e-3), CALL.replace(start_frequency_hz=80e3)]
)
def test_call_match_finds_other_presets(emitted):
    found = call_match(heard(emitted, noise=0.5))
    assert found.verdict == "differs"
    assert found.sweep.duration_s == pytest.approx(emitted.duration_s, rel=0.2)
    assert "opposite" not in found.warning


def sampled(rate_hz):
    """The call as a waveform at a sample rate that the settings state as 450 kHz."""
    time_s = np.arange(round(CALL.duration_s * rate_hz)) / rate_hz
    return CALL.replace(waveform=tuple(call_at(CALL, time_s).tolist()), sample_rate_hz=450e3)


@pytest.mark.parametrize(("rate_hz", "is_right"), [(450e3, True), (500e3, False), (400e3, False), (300e3, False)])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_waveforms_of_another_sample_rate_are_reported(rate_hz, is_right, noise):
    found = call_match(heard(CALL, noise=noise, settings=SETTINGS.replace(call=sampled(rate_hz))))
    assert (found.verdict == "matches", not found.warning) == (is_right, is_right)


def test_waveforms_beside_a_louder_sweep_of_another_sensor_match():
    other = CALL.replace(start_frequency_hz=90e3, stop_frequency_hz=60e3)
    settings = SETTINGS.replace(call=sampled(450e3))
    own, foreign = heard(CALL, noise=0.1, settings=settings), heard(other, echoes=((4e-3, 3.0),), settings=settings)
    both = replace(own, data=own.data + foreign.data)
    assert not call_match(both).warning


def chirps(start_khz, stop_khz, duration_ms, method, *, echoes=((8e-3, 1.0),), noise=0.01, rate_hz=450e3):
    """Echoes of a chirp of SciPy at 6 microphones of an array, as 32-bit floats."""
    time_s = np.arange(round(0.025 * rate_hz)) / rate_hz
    signals = noise * np.random.default_rng(2).standard_normal((len(time_s), 6))
    for delay_s, amplitude in echoes:
        for mic in range(6):
            since_s = time_s - delay_s - 11e-6 * mic
            inside = (since_s >= 0) & (since_s <= 1e-3 * duration_ms)
            edge_s = np.minimum(since_s, 1e-3 * duration_ms - since_s)[inside]
            ramp = np.sin(np.pi / 2 * np.minimum(1, edge_s / (1e-4 * duration_ms))) ** 2
            sound = chirp(since_s[inside], 1e3 * start_khz, 1e-3 * duration_ms, 1e3 * stop_khz, method)
            signals[inside, mic] += amplitude * ramp * sound
    places_m = tuple((0.0, 0.01 * mic, 0.003 * (mic % 3)) for mic in range(6))
    recording = Recording(sample_rate_hz=rate_hz, n_samples=len(time_s), encoding="float32")
    return Measurement(
        (0.1 * signals).astype("f4"), SETTINGS.replace(array=Array(positions_m=places_m), recording=recording)
    )


def compared(given, start_khz, stop_khz, duration_ms, modulation="hyperbolic"):
    call = Call(
        start_frequency_hz=1e3 * start_khz,
        stop_frequency_hz=1e3 * stop_khz,
        duration_s=1e-3 * duration_ms,
        modulation=modulation,
    )
    return call_match(Measurement(given.data, given.settings.replace(call=call)))


EMITTED = {
    "80 to 20 kHz": (80, 20, 2.5, "hyperbolic"),
    "60 to 30 kHz": (60, 30, 1.0, "hyperbolic"),
    "110 to 30 kHz": (110, 30, 3.0, "linear"),
    "25 to 50 kHz": (25, 50, 2.5, "logarithmic"),
}
STATED = [(45, 30, 2.5), (48, 38, 0.5, "linear"), (100, 40, 10), (30, 60, 5, "linear"), (70, 35, 1.0)]
SCENES = {
    "one echo": {},
    "weak echo": {"noise": 0.35},
    "six echoes": {"echoes": [(4e-3 + 1.7e-3 * place, (-0.8) ** place) for place in range(6)]},
    "direct sound": {"echoes": [(0.1e-3, 3.0), (8e-3, 0.1)]},
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("emitted", EMITTED)
def test_call_match_names_the_emitted_sweep(emitted, scene):
    start_khz, stop_khz, duration_ms, method = EMITTED[emitted]
    given = chirps(*EMITTED[emitted], **SCENES[scene])
    stated = STATED[(2 * [*EMITTED].index(emitted) + [*SCENES].index(scene)) % len(STATED)]
    found = compared(given, *stated)
    assert found.verdict == "differs", stated
    assert found.sweep.modulation == {"logarithmic": "exponential"}.get(method, method)
    assert found.sweep.duration_s == pytest.approx(1e-3 * duration_ms, rel=0.2)
    assert found.sweep.start_hz == pytest.approx(1e3 * start_khz, rel=0.15)
    assert found.sweep.stop_hz == pytest.approx(1e3 * stop_khz, rel=0.12)


@pytest.mark.parametrize("modulation", ["linear", "hyperbolic"])
def test_call_match_distinguishes_exponential_sweeps(modulation):
    found = compared(chirps(80, 20, 2.5, "logarithmic"), 80, 20, 2.5, modulation)
    assert "they look like an exponential sweep from about" in found.warning


def test_call_match_finds_calls_outside_of_the_band():
    found = compared(chirps(100, 60, 2.0, "hyperbolic"), 50, 25, 2.5)
    assert "hyperbolic sweep from about 98 to 61 kHz" in found.warning


def test_call_match_finds_pulses_of_a_tone():
    found = compared(chirps(40, 40, 1.0, "linear"), 50, 25, 2.5)
    assert "they look like pulses of a tone of about 40 kHz" in found.warning


def test_call_match_states_that_a_narrow_band_permits_no_judgement():
    found = compared(chirps(48, 38, 0.5, "linear"), 80, 20, 2.5)
    assert found.verdict == "unknown"
    assert re.match(r"echoes contain only about 3\d to 4\d kHz of the call", found.note)
    assert "if its emitter has no such band, another call was emitted" in found.note


def test_call_match_accepts_linear_calls_in_motion():
    """At 2 m/s, echoes are 1.2 % shorter, and their frequencies as much higher."""
    factor = 1 + 2 * 2.0 / 343
    moving = chirps(80 * factor, 20 * factor, 2.5 / factor, "linear")
    assert compared(moving, 80, 20, 2.5, "linear").verdict == "matches"


def test_call_match_does_not_judge_direct_sound_that_began_before_the_record():
    """The start of the call is missing, as if its band ended earlier."""
    assert (
        compared(chirps(50, 25, 2.5, "hyperbolic", echoes=[(-0.5e-3, 3.0), (9e-3, 0.05)]), 50, 25, 2.5).verdict
        == "matches"
    )


def test_call_match_accepts_the_call_beside_a_louder_reversed_one():
    both = heard(CALL).data + 3 * heard(REVERSED, echoes=((9e-3, 1.0),)).data
    assert call_match(Measurement(both, SETTINGS)).verdict == "matches"


@pytest.mark.parametrize("seed", range(3))
def test_call_match_accepts_many_echoes_of_the_call(seed):
    random = np.random.default_rng(seed)
    echoes = np.stack([random.uniform(1e-3, 14e-3, 60), random.standard_normal(60)], axis=1)
    assert call_match(heard(CALL, echoes=echoes, noise=0.1, seed=seed)).verdict == "matches"


@pytest.mark.parametrize(("apart_s", "amplitude"), [(48e-6, 1.0), (48e-6, -1.0), (66e-6, -1.0)])
def test_call_match_does_not_take_two_echoes_close_together_for_another_call(apart_s, amplitude):
    """Equal echoes from one direction cancel parts of the band in all microphones."""
    found = call_match(heard(CALL, echoes=((6e-3, 1.0), (6e-3 + apart_s, amplitude)), noise=0.005))
    assert found.verdict == "unknown"
    assert "or like two close echoes of the call; if they are not two echoes, another call was emitted" in found.warning


@pytest.mark.parametrize("seed", range(5))
def test_call_match_accepts_random_settings_and_scenes(seed):
    measurement, _ = budgets.measurement_of(seed)
    found = call_match(measurement)
    assert found.verdict != "differs"


def test_call_match_does_not_judge_noise_and_silence():
    silent, noisy = heard(CALL, echoes=()), heard(CALL, echoes=(), noise=1.0)
    assert call_match(silent) is SILENT
    assert call_match(noisy) is SILENT
    assert first_call_match([silent, noisy, heard(REVERSED)]).verdict == "differs"


def test_process_warns_of_another_call_on_stderr_and_in_the_file(tmp_path):
    write_recording(tmp_path / "rec.h5", [heard(REVERSED)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "rec.h5"), "--json"])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(tmp_path / "rec.energy.h5") as images:
        assert "opposite direction" in images.call_warning
        assert images.call_warning in done.stderr
        assert images.call_warning == json.loads(done.stdout)["sensors"][0]["call_warning"]
    assert "opposite direction" in CliRunner().invoke(cli, ["info", str(tmp_path / "rec.energy.h5")]).stdout


def test_process_of_a_folder_names_the_recordings_of_another_call(tmp_path):
    runs, images = tmp_path / "runs", tmp_path / "images"
    runs.mkdir()
    for name, call in {"same": CALL, "other": REVERSED}.items():
        write_recording(runs / f"{name}.h5", [heard(call)])
    done = CliRunner().invoke(cli, ["process", str(runs), "-o", f"{images}/", "--workers", "1"])
    assert done.exit_code == 0, done.stderr
    (warning,) = (line for line in done.stderr.splitlines() if "do not match" in line)
    assert "other.h5" in warning
    with open_energyscapes(images / "other.energy.h5") as other, open_energyscapes(images / "same.energy.h5") as same:
        assert other.call_warning in warning
        assert not same.call_warning


def test_process_stores_no_warning_if_echoes_match(tmp_path):
    write_recording(tmp_path / "rec.h5", [heard(CALL)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "rec.h5")])
    assert "do not match" not in done.stderr
    with open_energyscapes(tmp_path / "rec.energy.h5") as images:
        assert images.call_warning == ""


def test_pipelines_warn_once_of_another_call():
    with Pipeline(SETTINGS, "cpu", 1) as pipeline:
        with pytest.warns(CallMismatchWarning, match="opposite direction") as caught:
            pipeline.process(heard(REVERSED))
        pipeline.process(heard(REVERSED))
        assert [each.filename for each in caught if each.category is CallMismatchWarning] == [__file__]


def test_pipelines_without_prediction_do_not_compare_calls():
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline:
        pipeline.process(heard(REVERSED))


@pytest.mark.parametrize("n_dead", [1, 12])
@pytest.mark.parametrize("emitted", [CALL, REVERSED, CALL.replace(duration_s=0.7 * CALL.duration_s)])
def test_call_match_ignores_dead_channels(emitted, n_dead):
    measurement = heard(emitted, noise=0.05)
    data = measurement.data.copy()
    data[:, :n_dead] = 0
    match, intact = call_match(Measurement(data, SETTINGS)), call_match(measurement)
    assert match.verdict == intact.verdict
    if emitted is not CALL:
        assert match.sweep.low_hz == pytest.approx(intact.sweep.low_hz, rel=0.02)
        assert match.sweep.duration_s == pytest.approx(intact.sweep.duration_s, rel=0.02)


OWN = (50, 25, 2.5, "hyperbolic")
OTHERS = [(48, 27, 5, "linear"), (25, 50, 2.5, "hyperbolic"), (60, 30, 5, "linear")]


@pytest.mark.parametrize("other", OTHERS)
def test_call_match_names_the_call_of_another_sensor(other):
    own, foreign = chirps(*OWN, echoes=[(5e-3, 1.0), (9e-3, 0.5)]), chirps(*other, echoes=[(7e-3, 1.0)], noise=0.0)
    found = compared(replace(own, data=own.data + foreign.data), *OWN[:3])
    assert (found.verdict, found.foreign.modulation) == ("matches", other[3])
    assert found.foreign.duration_s == pytest.approx(1e-3 * other[2], rel=0.35)
    assert "rings of ghosts; silence it, or use equal calls on one SYNC chain" in found.warning


@pytest.mark.parametrize("count", [1, 4, 20])
@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_call_match_names_no_other_call_without_one(count, noise):
    echoes = [(3e-3 + 0.7e-3 * place, 0.9**place) for place in range(count)]
    found = compared(chirps(*OWN, echoes=echoes, noise=noise), *OWN[:3])
    assert (found.verdict, found.warning) == ("matches", "")


@pytest.mark.parametrize("seed", range(6))
def test_call_match_names_no_other_call_in_a_real_record(seed):
    """Echoes of a real room, with any microphones missing, are no call of another sensor."""
    rng = np.random.default_rng(seed)
    missing = (4, 9) if seed == 0 else tuple(rng.choice(32, rng.integers(1, 20), replace=False).tolist())
    settings = REAL.replace(array=REAL.array.replace(disabled=missing))
    assert call_match(replace(real(), settings=settings)).foreign is None


def test_process_notes_the_call_of_another_sensor(tmp_path):
    own, foreign = chirps(*OWN, echoes=[(5e-3, 1.0)]), chirps(*OTHERS[0], echoes=[(7e-3, 1.0)], noise=0.0)
    path = write_recording(tmp_path / "two.h5", [replace(own, data=own.data + foreign.data)])
    done = CliRunner().invoke(cli, ["process", str(path)])
    assert done.exit_code == 0, (done.stderr, done.exception)
    assert "besides the call of the settings, the record contains a linear sweep from about 4" in done.stderr
    done = CliRunner().invoke(cli, ["peaks", str(tmp_path / "two.energy.h5")])
    assert "note: sensor sensor: besides the call of the settings" in done.stderr, done.stderr
    assert "perhaps of another sensor" in CliRunner().invoke(cli, ["sensors", "check", str(path)]).stdout
