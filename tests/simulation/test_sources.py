"""Sounds other than the own call: other sensors, tones, noise, other sonars, the room."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.geometry import microphones
from ertis_numba.settings import Call, Recording
from ertis_numba.simulation import Ambient, Emitter, Noise, Point, Scene, Sonar, Tone
from ertis_numba.simulation.render import Simulator
from tests.scenes import (
    EAR,
    RATE_HZ,
    SENSOR,
    SPEED_M_S,
    arrival_s,
    bits_of,
    error_db,
    heard,
    line_array,
    only,
    scene_of,
    sorted_ways,
    ways,
    written_out,
)

LISTENS = SENSOR.replace(emitter=Emitter(silent=True))
LONG = Recording(n_samples=250_000)


def places_of(sensor):
    return np.array(sensor.position_m or (0, 0, 0)) + microphones(sensor.array).positions_m @ sensor.rotation().T


# ---- other sensors ---------------------------------------------------------------------------------


def test_foreign_call_travels_over_the_target():
    """From emitter j over the target to microphone i, and directly from j to i."""
    point_m = np.array([1.0, 0.5, -0.2])
    left = SENSOR.replace(name="left", position_m=(0.0, 0.5, 0.0), yaw_deg=-20)
    right = SENSOR.replace(name="right", position_m=(0.2, -0.4, 0.3), emitter=Emitter(level_db=-6))
    scene = Scene(sensors=(left, right), points=(Point(position_m=tuple(point_m), strength_db=0),))
    for name, receiver, transmitter in (("left", left, right), ("right", right, left)):
        own, echo, direct = ways(scene, "spreading", "cross_emission", sensor=name)
        places_m = places_of(receiver)
        back_m = np.linalg.norm(places_m - point_m, axis=1)
        there_m = np.linalg.norm(point_m - transmitter.position_m)
        own_m = np.linalg.norm(point_m - receiver.position_m)
        straight_m = np.linalg.norm(places_m - transmitter.position_m, axis=1)
        level = 10 ** (transmitter.emitter.level_db / 20)
        assert_allclose(own.delay_s, [(own_m + back_m) / SPEED_M_S], atol=1e-12)
        assert_allclose(echo.delay_s, [(there_m + back_m) / SPEED_M_S], atol=1e-12)
        assert_allclose(direct.delay_s, [straight_m / SPEED_M_S], atol=1e-12)
        assert_allclose(echo.amplitude[..., 0], [level / (there_m * back_m)])
        assert_allclose(direct.amplitude[..., 0], [level / straight_m])


def test_facing_sensors_receive_each_others_calls():
    """At 1 m, the sound takes 1 m / c, which is twice its range in an image."""
    near = EAR.replace(name="near", emitter=Emitter(diameter_m=0.02, level_db=-20))
    far = near.replace(name="far", position_m=(1.0, 0.0, 0.0), yaw_deg=180)
    scene = Scene(sensors=(near, far))
    names = ("spreading", "cross_emission", "emitter_directivity")
    for name in ("near", "far"):
        [signal] = heard(scene, *names, sensor=name)
        assert abs(arrival_s(signal, near.call, 1.0 / SPEED_M_S + 3e-7) * SPEED_M_S - 1.0) < 1e-6
        assert error_db(signal, written_out(near.call, np.array([[1.0 / SPEED_M_S]]), 0.1, 40_000)[0]) < -85
    away = scene.replace(sensors=(near, far.replace(yaw_deg=0)))
    assert not heard(away, *names, sensor="near").any()


def test_calls_of_other_sensors_keep_their_form():
    up = Call(start_frequency_hz=25_000.0, stop_frequency_hz=50_000.0, duration_s=1e-3)
    scene = Scene(sensors=(LISTENS, EAR.replace(name="up", call=up, position_m=(0.4, 0.0, 0.0))))
    [direct] = ways(scene, "cross_emission")
    assert direct.call == up
    assert error_db(heard(scene, "cross_emission"), written_out(up, direct.delay_s, 1.0, 40_000)) < -75


def test_silent_sensors_emit_no_call():
    scene = Scene(
        sensors=(LISTENS, LISTENS.replace(name="other", position_m=(1.0, 0.0, 0.0))), points=(Point(range_m=1),)
    )
    assert not heard(scene, "cross_emission", "spreading").any()


@pytest.mark.parametrize(("place", "wanted_ns"), [(0, (0, 400, 800)), (1, (-400, 0, 400)), (2, (-800, -400, 0))])
def test_each_sensor_of_the_chain_starts_400_ns_later(place, wanted_ns):
    """Sounds of another sensor shift by the delay of its emission after the record starts."""
    sensors = tuple(EAR.replace(name=f"s{n}", position_m=(0.0, 0.3 * n, 0.0)) for n in range(3))
    scene = Scene(sensors=sensors, points=(Point(position_m=(1.0, 0.2, 0.0)),))
    name = f"s{place}"
    together, chained = (ways(scene, "cross_emission", *more, sensor=name) for more in ((), ("sync_delay",)))
    later_s = [after.delay_s[0, 0] - before.delay_s[0, 0] for before, after in zip(together, chained, strict=True)]
    others = [wanted for number, wanted in enumerate(wanted_ns) if number != place for _ in range(2)]
    assert_allclose(later_s, np.array([0, *others]) * 1e-9, atol=3e-12)
    stamps = [
        Simulator(scene, sensor=name, plan=only("sync_delay")).render(1).stamp.timestamp_ns
        for name in ("s0", "s1", "s2")
    ]
    assert stamps == [50_000_000, 50_000_400, 50_000_800]


def test_delays_of_the_chain_appear_in_signals():
    sensors = LISTENS, EAR.replace(name="other", position_m=(0.5, 0.0, 0.0))
    signals = heard(Scene(sensors=sensors), "cross_emission", "sync_delay")
    delay_s = np.linalg.norm(places_of(LISTENS) - (0.5, 0, 0), axis=1) / SPEED_M_S + 400e-9
    assert error_db(signals, written_out(SENSOR.call, delay_s[None], 1.0, 40_000)) < -85


# ---- tones -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 3])
@pytest.mark.parametrize("frequency_hz", [39_990.0, 41_234.5])
def test_tones_have_frequency_level_and_phase(frequency_hz, index):
    """``a / r · sin(2π f (t - r / c))`` at every microphone; t continues from measurement to measurement."""
    tone = Tone(position_m=(0.6, -0.8, 0.3), frequency_hz=frequency_hz, level_db=-30)
    signals = heard(scene_of(sensor=LISTENS, tones=(tone,)), "interference", "spreading", index=index)
    way_m = np.linalg.norm(places_of(LISTENS) - tone.position_m, axis=1)
    time_s = index / 20.0 + np.arange(40_000) / RATE_HZ
    wanted = (
        10 ** (-30 / 20) / way_m[:, None] * np.sin(2 * np.pi * frequency_hz * (time_s - way_m[:, None] / SPEED_M_S))
    )
    assert_allclose(signals, wanted, atol=1e-9)


def test_tones_add_up_and_continue_between_measurements():
    still = Tone(position_m=(0.6, -0.8, 0.3), frequency_hz=40e3)
    moving = Tone(position_m=(1.0, 0.0, 0.0), velocity_m_s=(0.0, 2.0, 0.0), frequency_hz=30e3)
    both = heard(scene_of(sensor=LISTENS, tones=(still, moving), rate_hz=4.0), "interference", "spreading", index=1)
    alone = [
        heard(scene_of(sensor=LISTENS, tones=(tone,), rate_hz=4.0), "interference", "spreading", index=1)
        for tone in (still, moving.replace(position_m=(1.0, 0.5, 0.0), velocity_m_s=(0.0, 0.0, 0.0)))
    ]
    assert_allclose(both, alone[0] + alone[1], atol=1e-12)


def test_microphone_sensitivities_scale_tones():
    array = SENSOR.array.replace(gain=(1.0, 2.0, 0.5))
    tone = Tone(position_m=(0.6, -0.8, 0.3), frequency_hz=40e3)
    plain, calibrated = (
        heard(scene_of(sensor=LISTENS.replace(array=each), tones=(tone,)), "interference", "spreading")
        for each in (SENSOR.array, array)
    )
    assert_allclose(calibrated, plain * [[1.0], [2.0], [0.5]], atol=1e-15)


# ---- noise -----------------------------------------------------------------------------------------


def noisy(*noises, sensor=None, **more):
    sensor = (sensor or LISTENS).replace(recording=LONG)
    return scene_of(sensor=sensor, noises=noises, **more)


@pytest.mark.parametrize("band_hz", [(20e3, 80e3), (38e3, 42e3)])
def test_noise_has_level_and_band(band_hz):
    """A thousand samples with a bandwidth of 60 kHz give the level within 0.3 dB."""
    noise = Noise(position_m=(0.0, 0.0, 2.0), level_db=-20, band_hz=band_hz)
    signals = heard(noisy(noise), "interference", "spreading")
    way_m = np.linalg.norm(places_of(LISTENS) - noise.position_m, axis=1)
    independent = 2 * np.ptp(band_hz) * LONG.duration_s
    wanted_db = -20 - 20 * np.log10(way_m)
    bound_db = 4 * 10 * np.log10(1 + math.sqrt(2 / independent))
    assert_allclose(10 * np.log10(np.mean(signals**2, axis=1)), wanted_db, atol=bound_db)
    power = np.abs(np.fft.rfft(signals[0] * np.hanning(LONG.n_samples))) ** 2
    frequency_hz = np.fft.rfftfreq(LONG.n_samples, 1 / RATE_HZ)
    outside = (frequency_hz < band_hz[0] - 2e3) | (frequency_hz > band_hz[1] + 2e3)
    assert 10 * np.log10(power[outside].sum() / power.sum()) < -35
    edges_hz = np.linspace(*band_hz, 5)
    quarters, _ = np.histogram(frequency_hz, edges_hz, weights=power)
    assert_allclose(quarters / quarters.mean(), 1, atol=4 * math.sqrt(8 / independent))


def test_noise_of_a_source_is_delayed_between_microphones():
    """The peak of the correlation lies at the path difference."""
    sensor = LISTENS.replace(array=line_array(2, 0.1))
    noise = Noise(position_m=(1.0, 0.7, 0.0), level_db=0)
    first, second = heard(noisy(noise, sensor=sensor), "interference", "spreading")
    n = 2 * len(first)
    product = np.fft.rfft(second, n) * np.conj(np.fft.rfft(first, n))
    frequency_hz = np.fft.rfftfreq(n, 1 / RATE_HZ)
    way_m = np.linalg.norm(places_of(sensor) - noise.position_m, axis=1)
    wanted_s = (way_m[1] - way_m[0]) / SPEED_M_S
    lag_s = wanted_s + 2e-7
    for _ in range(4):
        turn = 2j * np.pi * frequency_hz
        turned = product * np.exp(turn * lag_s)
        lag_s -= np.sum(turned * turn).real / np.sum(turned * turn**2).real
    assert abs(lag_s - wanted_s) * 450e3 < 0.02
    aligned = np.fft.irfft(np.fft.rfft(second, n) * np.exp(turn * wanted_s))[: len(first)]
    assert np.corrcoef(aligned, first)[0, 1] > 0.98  # frames turn about their ends


def test_noise_continues_between_blocks():
    """Its level is constant, and it does not repeat."""
    [signal] = heard(noisy(Noise(position_m=(1.0, 0.0, 0.0), level_db=0), sensor=EAR), "interference", "spreading")
    parts = signal[: 30 * 8192].reshape(30, 8192)
    assert np.mean(parts**2, axis=1).std() < 0.2
    assert np.abs(np.corrcoef(parts) - np.eye(30)).max() < 0.35


def test_noise_depends_on_seed_and_index_and_source_only():
    noise = Noise(position_m=(1.0, 0.0, 0.0))
    sensors = EAR.replace(emitter=Emitter(silent=True)), EAR.replace(name="other", emitter=Emitter(silent=True))
    scene = Scene(seed=7, sensors=sensors, noises=(noise,))
    first = heard(scene, "interference", "spreading")[0]
    assert_array_equal(heard(scene, "interference", "spreading")[0], first)
    moved = scene.replace(noises=(noise.replace(level_db=-300), noise))
    others = (
        heard(scene.replace(seed=8), "interference", "spreading"),
        heard(scene, "interference", "spreading", index=1),
        heard(moved, "interference", "spreading"),
    )
    assert_array_equal(heard(scene, "interference", "spreading", sensor="other")[0], first)
    for other in others:
        assert abs(np.corrcoef(other[0], first)[0, 1]) < 0.2


def test_noise_does_not_depend_on_the_block_length(monkeypatch):
    scene = noisy(Noise(position_m=(1.0, 0.0, 0.0)), ambient=Ambient(level_dbfs=-60))
    whole = heard(scene, "interference", "spreading", "ambient_noise")
    monkeypatch.setattr("ertis_numba.simulation.synthesis.BLOCK", 10_007)
    assert error_db(heard(scene, "interference", "spreading", "ambient_noise"), whole) < -90


# ---- ambient noise ---------------------------------------------------------------------------------


def test_ambient_noise_has_its_level_at_every_microphone():
    sensor = LISTENS.replace(array=line_array(4, 0.05), recording=LONG)
    signals = heard(scene_of(sensor=sensor, ambient=Ambient(level_dbfs=-40)), "ambient_noise")
    assert_allclose(10 * np.log10(np.mean(signals**2, axis=1)), -40, atol=0.4)


def test_ambient_noise_is_coherent_as_a_diffuse_field():
    """``sin(k d) / (k d)`` between microphones at distance d, at several frequencies."""
    sensor = LISTENS.replace(array=line_array(11, 0.002), recording=Recording(n_samples=700_000))
    signals = heard(scene_of(sensor=sensor, ambient=Ambient(level_dbfs=-20)), "ambient_noise")
    frames = signals[:, : 170 * 4096].reshape(11, 170, 4096) * np.hanning(4096)
    spectra = np.fft.rfft(frames)
    frequency_hz = np.fft.rfftfreq(4096, 1 / RATE_HZ)
    for near_hz in (25e3, 40e3, 60e3):
        bins = np.flatnonzero(np.abs(frequency_hz - near_hz) < 3e3)
        cross = np.einsum("tf,mtf->m", spectra[0][:, bins].conj(), spectra[:, :, bins])
        power = np.einsum("mtf,mtf->m", spectra[:, :, bins].conj(), spectra[:, :, bins]).real
        coherence = cross.real / np.sqrt(power[0] * power)
        wave = 2 * np.pi * frequency_hz[bins] / SPEED_M_S
        wanted = [np.mean(np.sinc(wave * 0.002 * mic / np.pi)) for mic in range(11)]
        assert_allclose(coherence, wanted, atol=0.1)


# ---- other sonars ----------------------------------------------------------------------------------

SONAR = Sonar(position_m=(0.5, 0.0, 0.2), level_db=-6, period_s=0.003, offset_s=0.0005, call=Call(duration_s=1e-3))


@pytest.mark.parametrize("index", [0, 1, 7])
def test_calls_of_other_sonars_repeat_with_their_period(index):
    scene = scene_of(sensor=LISTENS, sonars=(SONAR,), rate_hz=100.0)
    way_m = np.linalg.norm(places_of(LISTENS) - SONAR.position_m, axis=1)
    begin_s = index / 100.0
    starts_s = SONAR.offset_s + SONAR.period_s * np.arange(50) - begin_s
    heard_s = starts_s[:, None] + way_m / SPEED_M_S
    audible = (heard_s + 1e-3 > 0).all(axis=1) & (heard_s < 40_000 / RATE_HZ).all(axis=1)
    [calls] = ways(scene, "interference", "spreading", index=index)
    assert_allclose(calls.delay_s, heard_s[audible], atol=2e-12)
    assert_allclose(calls.amplitude[..., 0], np.broadcast_to(10 ** (-6 / 20) / way_m, calls.delay_s.shape))
    wanted = written_out(SONAR.call, calls.delay_s, calls.amplitude[..., 0], 40_000)
    assert error_db(heard(scene, "interference", "spreading", index=index), wanted) < -75


def test_other_sonars_are_silent_before_their_first_call():
    late = SONAR.replace(offset_s=0.1)
    assert not ways(scene_of(sensor=LISTENS, sonars=(late,)), "interference", "spreading")
    delay_s, _ = sorted_ways(scene_of(sensor=LISTENS, sonars=(late,)), "interference", "spreading", index=2)
    assert delay_s[0] >= 0.5 / SPEED_M_S


def test_disabled_effect_removes_all_sources():
    scene = scene_of(
        sensor=LISTENS,
        sonars=(SONAR,),
        tones=(Tone(range_m=1, frequency_hz=40e3),),
        noises=(Noise(range_m=1),),
        ambient=Ambient(),
    )
    assert not heard(scene).any()


def test_sub_arrays_record_one_common_ambient_noise():
    """Channels are rendered 128 at a time; the coherence between parts follows from their distance."""
    sensor = LISTENS.replace(array=line_array(144, 0.01), recording=Recording(n_samples=50_000))
    scene = scene_of(sensor=sensor, ambient=Ambient(level_dbfs=-30))
    whole = heard(scene, "ambient_noise")
    frequency_hz = np.fft.rfftfreq(whole.shape[1], 1 / RATE_HZ)
    band = (frequency_hz > 20e3) & (frequency_hz < 80e3)
    rows = {mic: np.fft.rfft(whole[mic])[band] for mic in (0, 72, 128, 140)}
    found = np.fft.rfft(bits_of(Simulator(scene, plan=only("ambient_noise")).render())[[0, 72, 140]])[:, band]

    def likeness(one, other):
        return abs(np.vdot(one, other)) / np.linalg.norm(one) / np.linalg.norm(other)

    assert likeness(rows[0], rows[128]) < 0.1  # 1.28 m apart
    for row, mic in zip(found, (0, 72, 140), strict=True):
        assert likeness(row, rows[mic]) > 0.9  # what is rendered in parts is what is rendered as a whole
