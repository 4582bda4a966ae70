"""Simulated rooms against pyroomacoustics: delays and levels of image sources in a shoebox room."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Array, Call, Recording
from ertis_numba.simulation import Box, Emitter, Point, Scene, Sensor
from tests.scenes import EAR, SPEED_M_S, error_db, heard, sorted_ways

SIZE_M = (3.0, 4.0, 2.5)
AMPLITUDE = 0.9
"""What a wall leaves: the other simulator takes the energy that it absorbs."""
PLACES = [
    ((1.0, 1.2, 1.1), (2.1, 2.6, 1.4)),
    ((0.2, 3.7, 2.2), (0.9, 0.4, 0.3)),
    ((1.5, 2.01, 1.24), (1.52, 2.0, 1.27)),
]
LOW_RATE_HZ = 450_000


def equal_rooms(emitter_m, receiver_m, largest):
    """Return a pyroomacoustics room and the equal scene: one corner at the origin, a receiver and a transmitter."""
    import pyroomacoustics  # noqa: PLC0415 - a slow import

    room = pyroomacoustics.ShoeBox(
        SIZE_M, fs=LOW_RATE_HZ, max_order=largest, materials=pyroomacoustics.Material(1 - AMPLITUDE**2)
    )
    room.set_sound_speed(SPEED_M_S)
    room.add_source(emitter_m)
    room.add_microphone(receiver_m)
    room.image_source_model()
    box = Box(position_m=tuple(side_m / 2 for side_m in SIZE_M), size_m=SIZE_M, reflection_db=20 * np.log10(AMPLITUDE))
    sensors = (
        EAR.replace(position_m=receiver_m, emitter=Emitter(silent=True)),
        EAR.replace(name="mouth", position_m=emitter_m),
    )
    return room, Scene(sensors=sensors, boxes=(box,), max_reflections=largest)


@pytest.mark.parametrize(("emitter_m", "receiver_m"), PLACES)
@pytest.mark.parametrize(("largest", "count"), [(0, 1), (1, 7), (2, 25), (3, 63)])
def test_image_sources_agree_with_pyroomacoustics(emitter_m, receiver_m, largest, count):
    room, scene = equal_rooms(emitter_m, receiver_m, largest)
    delay_s, amplitude = sorted_ways(scene, "walls", "occlusion", "spreading", "cross_emission")
    [source] = room.sources
    way_m = np.linalg.norm(source.images - np.array(receiver_m)[:, None], axis=0)
    level = source.damping[0] / way_m
    order = np.argsort(way_m)
    assert len(delay_s) == count == len(way_m)
    assert_allclose(delay_s, way_m[order] / SPEED_M_S, atol=1e-8)  # pyroomacoustics uses single precision.
    assert_allclose(np.sort(amplitude), np.sort(level), rtol=1e-5)
    assert_allclose(amplitude * delay_s, (level * way_m)[order] / SPEED_M_S, rtol=1e-4)


@pytest.mark.parametrize(("emitter_m", "receiver_m"), PLACES[:2])
def test_rendered_signals_agree_with_pyroomacoustics(emitter_m, receiver_m):
    """Convolve the call with the impulse response of pyroomacoustics, sampled at 450 kHz."""
    import pyroomacoustics  # noqa: PLC0415 - a slow import

    room, scene = equal_rooms(emitter_m, receiver_m, 2)
    sensors = tuple(sensor.replace(recording=Recording(n_samples=140_000)) for sensor in scene.sensors)
    [signal] = heard(scene.replace(sensors=sensors), "walls", "occlusion", "spreading", "cross_emission")
    room.compute_rir()
    late = pyroomacoustics.constants.get("frac_delay_length") // 2  # Delay of its interpolation filters.
    impulses = room.rir[0][0][late:]
    wanted = np.convolve(impulses, call_samples(Call(), rate_hz=LOW_RATE_HZ))[:14_000]
    assert error_db(signal[::10][: len(wanted)], wanted) < -55


def test_sensor_receives_wall_echoes_of_its_own_emitter():
    """The microphone is at some distance from the emitter, like the second sensor of a pair."""
    pair = Array(layout="pair", positions_m=((0.0, -0.15, 0.1), (0.0, 0.15, -0.1)), word_bits=8)
    middle_m = (1.1, 1.7, 0.9)
    sensor = Sensor(array=pair, position_m=middle_m, recording=Recording(n_samples=40_000))
    room, scene = equal_rooms(middle_m, middle_m, 1)
    scene = scene.replace(sensors=(sensor,))
    delay_s, amplitude = sorted_ways(scene, "walls", "occlusion", "spreading")
    [source] = room.sources
    way_m = np.linalg.norm(source.images - (np.array(middle_m) + pair.positions_m[0])[:, None], axis=0)
    echoes = source.orders > 0
    order = np.argsort(way_m[echoes])
    assert_allclose(delay_s, way_m[echoes][order] / SPEED_M_S, atol=1e-8)
    assert_allclose(amplitude, (source.damping[0] / way_m)[echoes][order], rtol=1e-5)


def test_rotated_room_gives_the_same_signals():
    _, scene = equal_rooms(*PLACES[0], 2)
    [box] = scene.boxes
    turn = np.radians(35)
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])

    def turned(place_m):
        return tuple(float(part) for part in about_z @ place_m)

    other = scene.replace(
        boxes=(box.replace(position_m=turned(box.position_m), yaw_deg=35.0),),
        sensors=tuple(sensor.replace(position_m=turned(sensor.position_m)) for sensor in scene.sensors),
    )
    names = ("walls", "occlusion", "spreading", "cross_emission")
    assert_allclose(sorted_ways(other, *names), sorted_ways(scene, *names), rtol=1e-9)


def test_target_in_a_room_echoes_over_all_walls():
    """Both legs, emitter to target and target to microphone, have image sources; together at most two walls."""
    point_m = (1.9, 1.3, 0.8)
    middle_m = (1.0, 2.5, 1.1)
    room, scene = equal_rooms(middle_m, point_m, 2)
    scene = scene.replace(
        sensors=(EAR.replace(position_m=middle_m),), points=(Point(position_m=point_m, strength_db=0),)
    )
    [source] = room.sources
    way_m = np.linalg.norm(source.images - np.array(point_m)[:, None], axis=0)
    level = source.damping[0] / way_m
    together = source.orders[:, None] + source.orders <= 2
    wanted = np.sort((way_m[:, None] + way_m)[together])
    bare = scene.replace(boxes=scene.boxes, points=())
    names = ("walls", "occlusion", "spreading")
    own_s, own = sorted_ways(bare, *names)
    delay_s, amplitude = sorted_ways(scene, *names)
    assert len(delay_s) == len(wanted) + len(own_s)
    assert_allclose(np.sort(delay_s), np.sort(np.concatenate([wanted / SPEED_M_S, own_s])), atol=2e-8)
    assert_allclose(np.sort(amplitude), np.sort(np.concatenate([(level[:, None] * level)[together], own])), rtol=1e-4)
