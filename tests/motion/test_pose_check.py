"""Poses against the motion that echoes show: correct poses are accepted, wrong ones are named."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.pose_check import PoseCheck
from tests.motion.test_ego_motion import MOUNTINGS, TIME_NS, places_m, seen_from

N_PULSES = 7
YAW_RAD = 0.05 * np.arange(N_PULSES)
PATH = np.cumsum(0.04 * np.exp(1j * YAW_RAD)) + (0.2 - 0.1j)


def trajectory(place, yaw_rad):
    """Return planar poses at all pulses."""
    zero = np.zeros(len(yaw_rad))
    return ertis.Trajectory(
        TIME_NS * np.arange(len(yaw_rad)),
        np.stack([place.real, place.imag, zero], axis=1),
        np.stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)], axis=1),
    )


def warning(given, *, count=40, moves=True):
    """Return the warning of a check of poses by reflectors at rest, seen from the true path."""
    check = PoseCheck(MOUNTINGS)
    for pulse in range(N_PULSES):
        at = pulse if moves else 0
        pose = PATH[at].real, PATH[at].imag, YAW_RAD[at]
        check.add([seen_from(pose, places_m(count=count), pulse)], given)
    return check.warning()


def test_true_poses_are_accepted():
    draws = np.random.default_rng(3)
    noise = draws.normal(0, 0.01, (3, N_PULSES))
    assert warning(trajectory(PATH, YAW_RAD)) is None
    assert warning(trajectory(PATH + noise[0] + 1j * noise[1], YAW_RAD + 0.03 * noise[2])) is None
    # Another origin of the world changes no motion.
    assert warning(trajectory(1j * PATH + 50, YAW_RAD + math.pi / 2)) is None


@pytest.mark.parametrize(
    ("place", "yaw_rad", "cause"),
    [
        (-PATH * np.exp(-1j * YAW_RAD), -YAW_RAD, "the poses may be inverted, from world to platform; correct them"),
        (100 * PATH, YAW_RAD, "the poses may be in centimetres; correct them"),
        (PATH / 0.3048, YAW_RAD, "the poses may be in feet; correct them"),
        (PATH, YAW_RAD + math.pi / 2, "the poses may be 90° too large in yaw"),
        (PATH, YAW_RAD - math.pi / 2, "the poses may be 90° too small in yaw"),
        (PATH, YAW_RAD + math.pi, "the poses may be 180° off in yaw"),
    ],
)
def test_wrong_poses_are_named(place, yaw_rad, cause):
    found = warning(trajectory(place, yaw_rad))
    assert "in 1 of 1 parts of the path that were compared" in found
    assert cause in found


def test_motion_without_a_known_cause_is_a_contradiction():
    assert "correct the poses, their times or the mounting" in warning(trajectory(PATH * 2j, YAW_RAD))


def test_echoes_that_show_no_motion_say_nothing():
    assert warning(trajectory(100 * PATH, YAW_RAD), count=1) is None


def test_poses_that_stand_still_cost_nothing(monkeypatch):
    added = []
    monkeypatch.setattr(Odometry, "add", lambda _, items: added.append(items))
    check = PoseCheck(MOUNTINGS)
    given = trajectory(np.full(N_PULSES, 1 + 0j), np.zeros(N_PULSES))
    for pulse in range(N_PULSES):
        check.add([seen_from((1.0, 0.0, 0.0), places_m(), pulse)], given)
    assert len(added) == 1
    assert check.warning() is None
