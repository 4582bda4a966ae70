"""Sound of sources on its way to the microphones, compared with its equations in float64."""

import json

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import absorption_db_m
from ertis_numba.settings import Call, Recording
from ertis_numba.simulation import Emitter, Noise, Platform, Scene, Sonar, Tone, Wall
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.noise_frames import FRAME_S, frame_of, frames_between
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_recording
from tests.scenes import EAR, RATE_HZ, SENSOR, SPEED_M_S, error_db, heard, only, scene_of, ways

LISTENS = SENSOR.replace(emitter=Emitter(silent=True))
ALONE = EAR.replace(emitter=Emitter(silent=True))
LONG = ALONE.replace(recording=Recording(n_samples=250_000))
NAMES = ("interference", "spreading")
TIME_S = np.arange(40_000) / RATE_HZ


def mics_m(sensor=LISTENS):
    return microphones(sensor.array).positions_m


def tone_at(frequency_hz, sent_s):
    return np.sin(2 * np.pi * frequency_hz * sent_s)


def emission_s(source_m, mic_m, received_s):
    """Time at which sound left a source; both positions are functions of time. Bisection needs no formula."""
    early_s, late_s = received_s - 0.1, np.array(received_s)
    for _ in range(60):
        middle_s = (early_s + late_s) / 2
        way_m = np.linalg.norm(mic_m(received_s) - source_m(middle_s), axis=-1)
        too_late = middle_s + way_m / SPEED_M_S > received_s
        early_s, late_s = np.where(too_late, early_s, middle_s), np.where(too_late, middle_s, late_s)
    return early_s


def straight(start_m, velocity_m_s):
    return lambda time_s: np.array(start_m) + np.asarray(time_s)[..., None] * np.array(velocity_m_s)


def test_level_falls_with_distance_and_with_the_absorption_of_air():
    for frequency_hz in (20e3, 60e3):
        for range_m in (0.5, 4.0):
            tone = Tone(range_m=range_m, frequency_hz=frequency_hz, level_db=-20.0)
            [signal] = heard(scene_of(sensor=ALONE, tones=(tone,)), *NAMES, "absorption")[:, :36_000]
            absorbed_db = range_m * absorption_db_m(ALONE.air, np.array([frequency_hz]))[0]
            wanted_db = -20 - 20 * np.log10(range_m) - absorbed_db - 10 * np.log10(2)
            assert_allclose(10 * np.log10(np.mean(signal**2)), wanted_db, atol=1e-3)  # whole periods


def test_air_absorbs_each_frequency_of_noise_by_its_own_factor():
    noise = Noise(range_m=4.0, level_db=0.0)
    scene = scene_of(sensor=LONG, noises=(noise,))
    [plain], [absorbed] = heard(scene, *NAMES), heard(scene, *NAMES, "absorption")
    frequency_hz = np.fft.rfftfreq(len(plain), 1 / RATE_HZ)
    spectra = [np.abs(np.fft.rfft(each * np.hanning(len(each)))) ** 2 for each in (plain, absorbed)]
    for low_hz in (25e3, 45e3, 70e3):
        inside = (frequency_hz > low_hz) & (frequency_hz < low_hz + 500)
        ratio_db = 10 * np.log10(spectra[1][inside].sum() / spectra[0][inside].sum())
        assert_allclose(ratio_db, -4.0 * absorption_db_m(ALONE.air, np.array([low_hz + 250.0]))[0], atol=0.05)


@pytest.mark.parametrize("velocity_m_s", [(-10.0, 0.0, 0.0), (3.0, -20.0, 5.0)])
def test_tone_of_a_moving_source_left_it_at_the_retarded_time(velocity_m_s):
    tone = Tone(position_m=(1.0, 0.4, -0.2), velocity_m_s=velocity_m_s, frequency_hz=41e3, level_db=0.0)
    scene = scene_of(sensor=LISTENS, tones=(tone,))
    signals = heard(scene, *NAMES, "doppler")
    place = straight(tone.position_m, velocity_m_s)
    for signal, mic_m in zip(signals, mics_m(), strict=True):
        sent_s = emission_s(place, straight(mic_m, (0.0, 0.0, 0.0)), TIME_S)
        wanted = tone_at(41e3, sent_s) / np.linalg.norm(tone.position_m - mic_m)
        assert error_db(signal, wanted) < -110


def test_frequency_of_an_approaching_tone_is_shifted_by_the_doppler_factor():
    """``f / (1 - v / c)`` for a moving source, ``f (1 + v / c)`` for a moving sensor."""
    tone = Tone(range_m=2.0, frequency_hz=40e3, level_db=0.0)
    approaching = scene_of(sensor=ALONE, tones=(tone.replace(velocity_m_s=(-10.0, 0.0, 0.0)),))
    driving = Scene(
        sensors=(ALONE,),
        tones=(tone,),
        platform=Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 10.0, 0.0, 0.0, 0.0))),
    )
    for scene, wanted_hz in (
        (approaching, 40e3 / (1 - 10 / SPEED_M_S)),
        (driving, 40e3 * (1 + 10 / SPEED_M_S)),
    ):
        [signal] = heard(scene, *NAMES, "doppler")
        phase_rad = np.unwrap(np.angle(scipy.signal.hilbert(signal)))[5_000:35_000]
        found_hz = np.polyfit(TIME_S[5_000:35_000], phase_rad, 1)[0] / (2 * np.pi)
        assert_allclose(found_hz, wanted_hz, atol=0.05)


def test_tone_over_a_moving_wall_is_shifted_twice():
    """A wall that approaches both at v shifts by the factor (c + v) / (c - v), here to first order in v / c."""
    wall = Wall(position_m=(2.0, 0.0, 0.0), velocity_m_s=(-2.0, 0.0, 0.0), facing_deg=(180.0, 0.0))
    scene = scene_of(sensor=ALONE, tones=(Tone(range_m=0.3, frequency_hz=40e3),), walls=(wall,))
    [both], [direct] = heard(scene, *NAMES, "walls", "doppler"), heard(scene, *NAMES, "doppler")
    phase_rad = np.unwrap(np.angle(scipy.signal.hilbert(both - direct)))[5_000:35_000]
    found_hz = np.polyfit(TIME_S[5_000:35_000], phase_rad, 1)[0] / (2 * np.pi)
    assert_allclose(found_hz, 40e3 * (SPEED_M_S + 2) / (SPEED_M_S - 2), atol=40e3 * (2 / SPEED_M_S) ** 2)


@pytest.mark.parametrize("velocity_m_s", [(0.0, 0.0, 0.0), (-4.0, 3.0, 0.0)])
def test_noise_of_a_source_is_one_waveform_at_the_retarded_time(velocity_m_s):
    """Frames travel with the velocities at their centres; the error is that of the curvature of the path."""
    noise = Noise(position_m=(1.5, 0.4, -0.2), velocity_m_s=velocity_m_s, level_db=0.0)
    scene = scene_of(sensor=LISTENS, noises=(noise,), rate_hz=30.0)
    signals = heard(scene, *NAMES, "doppler", index=2)
    begin_s = 2 / 30.0
    place = straight(noise.position_m, velocity_m_s)
    for signal, mic_m in zip(signals, mics_m(), strict=True):
        sent_s = emission_s(place, straight(mic_m, (0.0, 0.0, 0.0)), begin_s + TIME_S)
        sound = np.zeros(len(sent_s))
        for number in frames_between(sent_s[0], sent_s[-1]):
            sound += frame_of(noise, (7, *b"interference", 0), number).at(sent_s - number * FRAME_S / 2)
        wanted = sound / np.linalg.norm(place(begin_s) - mic_m)
        assert error_db(signal, wanted) < (-40 if any(velocity_m_s) else -85)


def test_two_sensors_receive_one_noise_with_the_delay_of_their_distances():
    far = ALONE.replace(name="far", position_m=(-0.5, 0.0, 0.0))
    scene = Scene(seed=7, sensors=(ALONE, far), noises=(Noise(range_m=1.0, level_db=0.0),))
    [near_one], [far_one] = heard(scene, *NAMES, sensor="sensor"), heard(scene, *NAMES, sensor="far")
    n = 2 * len(near_one)
    product = np.fft.rfft(far_one, n) * np.conj(np.fft.rfft(near_one, n))
    lag = np.argmax(np.fft.irfft(product, n)[: n // 2])
    assert_allclose(lag / RATE_HZ * SPEED_M_S, 0.5, atol=2 * SPEED_M_S / RATE_HZ)


def test_wall_adds_the_sound_of_the_mirror_image():
    tone = Tone(position_m=(1.0, 0.5, 0.0), frequency_hz=40_123.0)
    image = tone.replace(position_m=(1.0, -2.5, 0.0))
    wall = Wall(position_m=(0.0, -1.0, 0.0), facing_deg=(90.0, 0.0), reflection_db=-6.0)
    effects = (*NAMES, "absorption", "walls", "occlusion")
    reflected = heard(scene_of(sensor=LISTENS, tones=(tone,), walls=(wall,)), *effects)
    both = (tone, image.replace(level_db=-66.0))
    assert_allclose(reflected, heard(scene_of(sensor=LISTENS, tones=both), *effects), atol=1e-12)
    once = scene_of(sensor=LISTENS, tones=(tone,), walls=(wall,), max_reflections=0)
    assert_allclose(heard(once, *effects), heard(scene_of(sensor=LISTENS, tones=(tone,)), *effects), atol=1e-15)


def test_wall_blocks_the_sound_behind_it():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(1.0, 1.0))
    tone, noise = Tone(range_m=1.0, frequency_hz=40e3), Noise(range_m=1.0)
    scene = scene_of(sensor=LISTENS, tones=(tone,), noises=(noise,), sonars=(Sonar(range_m=1.0),), walls=(wall,))
    assert heard(scene, *NAMES).any()
    assert not heard(scene, *NAMES, "walls", "occlusion").any()


def test_pistons_emit_along_their_axis():
    """``2 J₁(v) / v`` with ``v = π d f sin θ / c``, and nothing behind."""
    for turned_deg in (0.0, 10.0, 40.0):
        tone = Tone(range_m=1.0, frequency_hz=40e3, diameter_m=0.02, facing_deg=(180.0 - turned_deg, 0.0))
        [signal] = heard(scene_of(sensor=ALONE, tones=(tone,)), *NAMES, "emitter_directivity")
        v = np.pi * 0.02 * 40e3 / SPEED_M_S * np.sin(np.radians(turned_deg))
        wanted = 1e-3 * (2 * scipy.special.j1(v) / v if v else 1.0)
        assert_allclose(np.sqrt(2 * np.mean(signal[:36_000] ** 2)), abs(wanted), rtol=1e-3)
    away = scene_of(sensor=ALONE, tones=(tone.replace(facing_deg=(0.0, 0.0)),))
    assert not heard(away, *NAMES, "emitter_directivity").any()


def test_tone_has_harmonics_and_modulation():
    tone = Tone(
        range_m=1.0,
        frequency_hz=15e3,
        level_db=-20.0,
        harmonics_db=(-6.0, -12.0),
        modulation_hz=170.0,
        modulation_depth=0.7,
    )
    signals = heard(scene_of(sensor=LISTENS, tones=(tone,), rate_hz=10.0), *NAMES, index=1)
    for signal, mic_m in zip(signals, mics_m(), strict=True):
        way_m = np.linalg.norm((1.0, 0.0, 0.0) - mic_m)
        sent_s = 0.1 + TIME_S - way_m / SPEED_M_S
        levels = 10 ** (np.array([-20.0, -26.0, -32.0]) / 20)
        wanted = sum(level * tone_at(n * 15e3, sent_s) for n, level in enumerate(levels, 1)) / way_m
        assert_allclose(signal, wanted * (1 + 0.7 * tone_at(170.0, sent_s)), atol=1e-9)


def mean_density(noise, band_hz):
    """Power of the recorded noise at 1 m in bands of 5 kHz."""
    [signal] = heard(scene_of(sensor=LONG, noises=(noise,)), *NAMES)
    frequency_hz = np.fft.rfftfreq(len(signal), 1 / RATE_HZ)
    edges_hz = np.arange(*band_hz, 5e3)
    power, _ = np.histogram(frequency_hz, edges_hz, weights=np.abs(np.fft.rfft(signal)) ** 2)
    return (edges_hz[1:] + edges_hz[:-1]) / 2, power / power.sum()


def test_leak_has_the_spectrum_of_a_jet():
    """``x² / (1 + x²)²`` with ``x = f d / (0.2 U)``: highest at 0.2 U / d, with slopes of 6 dB per octave."""
    noise = Noise(range_m=1.0, band_hz=(10e3, 160e3), spectrum="leak", orifice_m=1.5e-3)
    peak_hz = 0.2 * 313.0 / 1.5e-3
    assert_allclose(noise.peak_hz, peak_hz)
    at_hz, power = mean_density(noise, (15e3, 155e3))
    x = at_hz / peak_hz
    wanted = x**2 / (1 + x**2) ** 2
    independent = 2 * 5e3 * LONG.recording.duration_s
    assert_allclose(power / (wanted / wanted.sum()), 1.0, atol=5 * np.sqrt(2 / independent))
    far = noise.density(np.array([peak_hz / 100, peak_hz / 50, peak_hz, 50 * peak_hz, 100 * peak_hz]))
    assert_allclose(10 * np.log10(far[[1, 3]] / far[[0, 4]]), 6.02, atol=0.01)
    assert far.argmax() == 2


@pytest.mark.parametrize("velocity_m_s", [(0.0, 0.0, 0.0), (-4.0, 3.0, 0.0)])
def test_noise_above_half_of_the_sample_rate_does_not_fold(velocity_m_s):
    slow = ALONE.replace(recording=Recording(encoding="float32", sample_rate_hz=225e3, n_samples=8192))
    inside = Noise(range_m=1.0, velocity_m_s=velocity_m_s, band_hz=(20e3, 80e3), level_db=0.0)
    [signal] = heard(scene_of(sensor=slow, noises=(inside,)), *NAMES, "doppler")
    assert_allclose(10 * np.log10(np.mean(signal**2)), 0.0, atol=0.6)
    [signal] = heard(scene_of(sensor=slow, noises=(inside.replace(band_hz=(150e3, 200e3)),)), *NAMES, "doppler")
    assert 10 * np.log10(np.mean(signal**2)) < -80


def test_noise_follows_a_given_spectrum_and_keeps_its_level():
    given = ((20e3, -20.0), (40e3, 0.0), (80e3, 0.0))
    noise = Noise(range_m=1.0, spectrum=given, level_db=-20.0)
    [signal] = heard(scene_of(sensor=LONG, noises=(noise,)), *NAMES)
    assert_allclose(10 * np.log10(np.mean(signal**2)), -20.0, atol=0.4)
    at_hz, power = mean_density(noise, (20e3, 80e3))
    wanted = 10 ** (np.interp(at_hz, [20e3, 40e3, 80e3], [-20.0, 0.0, 0.0]) / 10)
    independent = 2 * 5e3 * LONG.recording.duration_s
    assert_allclose(power / (wanted / wanted.sum()), 1.0, atol=5 * np.sqrt(2 / independent))


def test_calls_of_a_flying_bat_arrive_stretched():
    call = Call(start_frequency_hz=80e3, stop_frequency_hz=30e3, duration_s=2e-3)
    bat = Sonar(position_m=(2.0, 0.0, 0.0), velocity_m_s=(-6.0, 0.0, 0.0), call=call, period_s=0.01, level_db=0.0)
    [calls] = ways(scene_of(sensor=ALONE, sonars=(bat,)), *NAMES, "doppler")
    sent_s = np.array([-0.0, 0.01]) if len(calls.delay_s) == 2 else np.array([0.0])
    wanted_s = sent_s + (2.0 - 6.0 * sent_s) / SPEED_M_S
    assert_allclose(calls.delay_s[:, 0], wanted_s[: len(calls.delay_s)], atol=1e-11)
    assert_allclose(calls.stretch, 1 - 6.0 / SPEED_M_S, atol=1e-9)


def test_effects_on_sources_are_chosen_although_a_silent_sensor_has_no_echoes():
    wall = Wall(position_m=(0.0, -1.0, 0.0), facing_deg=(90.0, 0.0))
    moving = Noise(range_m=2.0, velocity_m_s=(-3.0, 0.0, 0.0), diameter_m=0.01)
    scene = scene_of(sensor=LISTENS, noises=(moving,), walls=(wall,))
    wanted = {"spreading", "walls", "absorption", "doppler", "emitter_directivity", "interference"}
    assert wanted <= make_plan(scene).active
    assert "occlusion" not in make_plan(scene).active
    verdicts = {each.name: each for each in make_plan(scene).verdicts}
    assert "noises[0]" in verdicts["absorption"].reason
    off = make_plan(scene.replace(effects={"interference": False}))
    assert not (wanted - {"emitter_directivity", "spreading"}) & off.active


def test_inaudible_source_needs_no_effects():
    scene = scene_of(sensor=LISTENS, tones=(Tone(range_m=300.0, frequency_hz=40e3, level_db=-200.0),))
    assert make_plan(scene).active == {"propagation", "modulation", "interference"}


def test_blocked_sources_are_silent_and_render():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(1.0, 1.0))
    scene = scene_of(sensor=LISTENS, tones=(Tone(range_m=1.0, frequency_hz=40e3),), walls=(wall,))
    assert "occlusion" in make_plan(scene).active
    assert_array_equal(heard(scene, *make_plan(scene).active), 0.0)


def test_truth_names_sources_with_place_and_recorded_level():
    """Levels are those of the rendered signals; positions follow the motion, directions are in the sensor frame."""
    sensor = LISTENS.replace(position_m=(0.0, 0.0, 0.5), yaw_deg=90.0, recording=LONG.recording)
    wall = Wall(position_m=(0.0, -1.0, 0.0), facing_deg=(90.0, 0.0))
    fan = Tone(position_m=(0.0, 1.0, 0.5), frequency_hz=40e3, harmonics_db=(-6.0,), level_db=-20.0)
    leak = Noise(position_m=(1.0, 1.0, 0.5), velocity_m_s=(-2.0, 0.0, 0.0), spectrum="leak", orifice_m=2e-3)
    scene = Scene(seed=3, sensors=(sensor,), tones=(fan,), noises=(leak,), walls=(wall,), rate_hz=4.0, count=3)
    plan = make_plan(scene)
    for index in (0, 2):
        of_fan, of_leak = Simulator(scene, plan=plan).sources(index)
        for found, kind, changes in ((of_fan, "tone", {"noises": ()}), (of_leak, "noise", {"tones": ()})):
            signals = Simulator(scene.replace(**changes), plan=plan).signals(index)
            assert_allclose(found.level_dbfs, 10 * np.log10(np.mean(signals**2)), atol=0.5 if kind == "noise" else 0.01)
            assert found.kind == kind
        assert_allclose((of_fan.azimuth_deg, of_fan.elevation_deg, of_fan.range_m), (0.0, 0.0, 1.0), atol=1e-9)
        assert (of_fan.band_hz, of_leak.band_hz) == ((40e3, 80e3), (20e3, 80e3))
        assert_allclose(of_leak.position_m, (1.0 - 0.5 * index, 1.0, 0.5), atol=1e-12)
    assert_allclose(of_leak.azimuth_deg, 0.0, atol=1e-9)
    without = plan.active - {"interference"}
    assert Simulator(scene, plan=only(*without)).sources() == []


def test_simulated_recording_holds_the_sources_of_its_scene(tmp_path):
    path = tmp_path / "scene.toml"
    bat = Sonar(waypoints=((0.0, 2.0, 0.0, 0.0), (0.2, 1.0, 1.0, 0.0)), level_db=-20.0)
    path.write_text(scene_of(sensor=LISTENS, sonars=(bat,), count=3, rate_hz=10.0).to_toml(), encoding="utf-8")
    done = CliRunner().invoke(cli, ["simulate", str(path), "--json"])
    assert done.exit_code == 0, done.output
    [reported] = json.loads(done.stdout)["sensors"]
    with open_recording(path.with_suffix(".h5")) as recording:
        sources = [row[0] for row in recording.truth.sources]
    assert reported["sources"][0]["name"] == sources[0].name == "sonars[0]"
    assert_allclose([each.position_m for each in sources], [(2, 0, 0), (1.5, 0.5, 0), (1, 1, 0)], atol=1e-9)
    assert_allclose([each.azimuth_deg for each in sources], np.degrees(np.arctan2([0, 0.5, 1], [2, 1.5, 1])))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Noise(range_m=1.0, spectrum="leak"), "use noise.orifice_m with spectrum"),
        (lambda: Noise(range_m=1.0, orifice_m=1e-3), "use noise.orifice_m with spectrum"),
        (lambda: Noise(range_m=1.0, spectrum=((2e4, 0.0), (2e4, 0.0))), "sort them in increasing order"),
        (lambda: Noise(range_m=1.0, spectrum=()), "levels of noise.spectrum"),
        (lambda: Tone(range_m=1.0, frequency_hz=1e4, modulation_depth=0.5), "add tone.modulation_hz"),
        (lambda: Tone(range_m=1.0, frequency_hz=1e4, modulation_hz=2e4), "tone.modulation_hz"),
        (lambda: Tone(range_m=1.0, frequency_hz=1e4, facing_deg=(0.0, 0.0)), "add tone.diameter_m"),
        (lambda: Sonar(range_m=1.0, diameter_m=0.3), "sonar.diameter_m"),
    ],
)
def test_contradicting_keys_of_sources_are_errors(make, message):
    with pytest.raises(ArgumentError, match=message):
        make()
