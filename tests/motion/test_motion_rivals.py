"""Motions that rival the right one: mirrored echoes, standing still beside moving objects, and objects alone."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import DataError
from tests.motion.test_ego_motion import MOUNTINGS, TIME_NS, places_m, seen_from

TWIST = (1.2, 0.0, 0.0)


def joined(first, second, amplitude=1.0):
    """Return the points of two clouds as one; those of the second have another amplitude."""
    levels = np.repeat(np.float32([1.0, amplitude]), [len(first), len(second)])
    return first.replace(position_m=np.concatenate([first.position_m, second.position_m]), amplitude=levels)


def mirrored_view(pulse, n_ahead, n_behind, seed):
    """Return the points of a flat array that drives ahead, and hears as many calls from behind."""
    x = TWIST[0] * pulse * TIME_NS / 1e9
    ahead = seen_from((x, 0, 0), places_m(seed, n_ahead), pulse, TWIST)
    behind = seen_from((-x, 0, 0), places_m(seed + 100, n_behind), pulse, (-TWIST[0], 0.0, 0.0))
    return joined(ahead, behind, 0.7)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n_ahead", "n_behind"), [(20, 20), (12, 25), (25, 10)])
def test_single_flat_array_with_mirrored_echoes_does_not_claim_a_direction(seed, n_ahead, n_behind):
    odometry = ertis.Odometry(MOUNTINGS)
    clouds = [mirrored_view(pulse, n_ahead, n_behind, seed) for pulse in range(3)]
    assert [odometry.add([cloud]) for cloud in clouds] == [None] * 3
    assert [pose.doubt for pose in odometry.poses] == ["", "other motion", "other motion"]
    error_m = odometry.poses[-1].x_m - 0.24
    assert abs(error_m) < 3 * math.sqrt(odometry.poses[-1].covariance[0, 0]) < 3
    found = ertis.ego_velocity(clouds[:1], clouds[1:2], MOUNTINGS)
    assert abs(found.velocity_m_s[0] - TWIST[0]) < 3 * found.sd[0]


TURNED = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
FRONT = {"sensor": ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}


@pytest.mark.parametrize(
    ("mountings", "twist", "alone", "doubt"),
    [
        (FRONT, (1.0, 0.0, 0.0), None, "other motion"),
        (FRONT, (-0.4, 0.2, 0.3), None, "other motion"),
        (FRONT, (1.0, 0.0, 0.0), False, "other motion"),
        (FRONT, (1.0, 0.0, 0.0), True, ""),
        (FRONT, (0.0, 0.5, 0.0), None, ""),  # Mirrored reflectors move sideways as well.
        (FRONT, (0.0, 0.0, 0.0), None, ""),
        (MOUNTINGS, (1.0, 0.0, 0.0), None, ""),  # The sensor is the platform.
        (MOUNTINGS, (1.0, 0.0, 0.0), False, "other motion"),
        ({"sensor": ((0.0, 0.0, 0.0), TURNED)}, (1.0, 0.5, 0.0), None, "other motion"),
    ],
)
def test_single_flat_array_that_may_hear_others_does_not_distinguish_ahead_and_behind(mountings, twist, alone, doubt):
    """Echoes of others' calls may be all that it hears."""
    pulses = [[seen_from(np.array(twist) * pulse * TIME_NS / 1e9, places_m(4, 30), pulse, twist)] for pulse in range(3)]
    odometry = ertis.Odometry(mountings, alone=alone)
    velocities = [odometry.add(pulse) for pulse in pulses]
    assert [pose.doubt for pose in odometry.poses[1:]] == [doubt] * 2
    assert all((velocity is None) == bool(doubt) for velocity in velocities[1:])
    found = ertis.ego_velocity(*pulses[:2], mountings, alone=alone)
    assert (found.sd[:2].max() > 0.1) == bool(doubt)


def test_single_omnidirectional_emitter_is_heard_from_behind():
    pulses = [seen_from((0.1 * pulse, 0, 0), places_m(4, 30), pulse, (1.0, 0.0, 0.0)) for pulse in range(2)]
    array = pulses[0].settings.array.replace(emitter_diameter_m=0.0)
    omnidirectional = [pulse.replace(settings=pulse.settings.replace(array=array)) for pulse in pulses]
    for clouds, is_doubtful in ((pulses, False), (omnidirectional, True)):
        found = ertis.ego_velocity(clouds[:1], clouds[1:], MOUNTINGS)
        assert (found.sd[0] > 0.5) == is_doubtful


def walker(pulse, places, way_m):
    """Return places of a person who has walked for some pulses."""
    return places + np.array([*way_m, 0.0]) * pulse


PERSON = np.array([[1.5, 0.3, 0.0], [1.6, 0.1, 0.0], [1.45, 0.15, 0.0], [1.7, 0.35, 0.0]])


@pytest.mark.parametrize("way_m", [(-0.12, 0.0), (0.08, 0.1), (0.0, -0.15)])
@pytest.mark.parametrize("count", [0, 2, 4, 12])
def test_platform_at_rest_does_not_move_with_a_person(way_m, count):
    """Without enough reflectors at rest, the motion is unknown; the echoes of the person are stronger."""
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(3):
        person = seen_from((0, 0, 0), walker(pulse, PERSON, way_m), pulse)
        odometry.add([joined(person, seen_from((0, 0, 0), places_m(3, count), pulse), 0.3)])
    for pose in odometry.poses[1:]:
        assert math.hypot(pose.x_m, pose.y_m) < 3 * math.sqrt(np.trace(pose.covariance[:2, :2])) + 1e-3
        assert not pose.is_measured or math.hypot(pose.x_m, pose.y_m) < 2e-3
        assert pose.is_measured == (pose.doubt == "")
    assert odometry.poses[-1].is_measured == (count == 12)


def test_smooth_walls_on_both_sides_are_not_evidence_of_standing_still():
    """The nearest points of walls, and of their mirror images, move with the platform along a corridor."""
    walls = np.array([[0.0, y_m, 0.0] for y_m in (-6.0, -3.6, -1.2, 1.2, 3.6, 6.0)])
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(3):
        odometry.add([seen_from((0, 0, 0), walls, pulse)])
    assert [pose.is_measured for pose in odometry.poses[1:]] == [False, False]


def test_ego_velocity_refuses_a_single_moving_object():
    groups = [[seen_from((0, 0, 0), walker(pulse, PERSON, (0.1, 0.05)), pulse)] for pulse in (0, 1)]
    with pytest.raises(
        DataError, match="4 echoes of before and after match, in 1 place, as many as echoes of noise or of one"
    ):
        ertis.ego_velocity(*groups, MOUNTINGS)


def test_errors_of_successive_doubtful_steps_add_up():
    """A wrong motion may last, so deviations add up rather than variances."""
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(5):
        odometry.add([mirrored_view(pulse, 20, 20, 1)])
    sd_m = [math.sqrt(pose.covariance[0, 0]) for pose in odometry.poses]
    assert sd_m[4] == pytest.approx(4 * sd_m[1], rel=0.2)
