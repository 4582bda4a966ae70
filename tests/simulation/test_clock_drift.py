"""Sample clocks that run fast or slow, compared with closed-form delays."""

import pytest
from numpy.testing import assert_allclose

from ertis_numba.simulation import Electronics, Emitter, Point
from ertis_numba.simulation.effect_plan import make_plan
from tests.scenes import EAR, SPEED_M_S, arrival_s, error_db, heard, scene_of, seen, vector, ways, written_out

FAST = Electronics(clock_drift_ppm=200.0)


def test_own_echoes_shift_by_drift_times_delay():
    scene = scene_of(Point(range_m=0.9, strength_db=0.0), sensor=EAR.replace(electronics=FAST))
    plain, drifted = (heard(scene, *names)[0] for names in ((), ("clock_drift",)))
    delay_s = 1.8 / SPEED_M_S
    shift_s = arrival_s(drifted, EAR.call, delay_s + 1e-6) - arrival_s(plain, EAR.call, delay_s)
    assert shift_s == pytest.approx(200e-6 * delay_s, rel=1e-3)
    assert ways(scene, "clock_drift")[0].stretch is None  # the call and the record share one clock


def scene_of_two(listener_ppm, emitter_ppm, **more):
    """A scene with a sensor that receives the call of another sensor 0.5 m away."""
    receiver = EAR.replace(electronics=Electronics(clock_drift_ppm=listener_ppm), emitter=Emitter(silent=True))
    transmitter = EAR.replace(
        name="mouth", position_m=vector((0.5, 0.0, 0.0)), electronics=Electronics(clock_drift_ppm=emitter_ppm)
    )
    return scene_of(sensor=receiver, **more).replace(sensors=(receiver, transmitter))


@pytest.mark.parametrize(("listener_ppm", "emitter_ppm"), [(50, 0), (0, 50), (-30, 40), (80, 80)])
@pytest.mark.parametrize(("sync_every", "index", "since_s"), [(1, 3, 0.0), (10, 0, 0.0), (10, 3, 0.15), (2, 3, 0.05)])
def test_other_calls_shift_by_drift_times_time_since_sync(listener_ppm, emitter_ppm, sync_every, index, since_s):
    scene = scene_of_two(listener_ppm, emitter_ppm, count=20, sync_every=sync_every)
    listener, emitter = 1e-6 * listener_ppm, 1e-6 * emitter_ppm
    [found] = ways(scene, "cross_emission", "clock_drift", index=index)
    way_s = 0.5 / SPEED_M_S
    # In true time, an interval T of the emitter lasts T / (1 + e); the receiver counts (1 + d) for each second.
    wanted_s = (1 + listener) * (since_s / (1 + emitter) + way_s) - since_s
    assert_allclose(found.delay_s, wanted_s, atol=1e-12)
    assert wanted_s - way_s == pytest.approx((listener - emitter) * since_s + listener * way_s, abs=1e-8)
    if listener == emitter:
        assert found.stretch is None
    else:
        assert_allclose(found.stretch, (1 + listener) / (1 + emitter), atol=1e-12)


def test_other_calls_are_stretched_by_the_drift_ratio():
    scene = scene_of_two(500.0, -500.0)
    [found] = ways(scene, "cross_emission", "clock_drift")
    signals = heard(scene, "cross_emission", "clock_drift")
    assert error_db(signals, written_out(EAR.call, found.delay_s, 1.0, 40_000, stretch=1.0005 / 0.9995)) < -60


def test_other_calls_that_end_before_the_record_are_omitted():
    scene = scene_of_two(-500.0, 500.0, count=1000, sync_every=1000)
    assert heard(scene, "cross_emission", "clock_drift", index=0).any()
    assert not heard(scene, "cross_emission", "clock_drift", index=900).any()


def test_clock_drift_does_not_move_the_ground_truth():
    scene = scene_of(Point(range_m=0.9), sensor=EAR.replace(electronics=FAST))
    assert seen(scene, "clock_drift")[0].range_m == pytest.approx(0.9)


def test_drift_verdict_uses_last_measurement_before_sync():
    """The clocks agree at first, but after a hundred measurements the call of the other sensor is shifted."""
    point = Point(range_m=0.7, strength_db=-15.0)
    receiver = EAR.replace(emitter=Emitter(level_db=-15.0), electronics=Electronics(clock_drift_ppm=10.0))
    other = receiver.replace(name="other", position_m=(1.0, 0.2, 0.0), yaw_deg=180.0, electronics=Electronics())
    scene = scene_of(point, sensor=receiver).replace(sensors=(receiver, other), count=100)

    def change_db(scene):
        return next(each.estimate_db for each in make_plan(scene).verdicts if each.name == "clock_drift")

    assert change_db(scene) < scene.tolerance_db < change_db(scene.replace(sync_every=100))
