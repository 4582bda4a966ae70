"""Poses against the motion that echoes show: correct poses are accepted, wrong ones are named."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.pose_check import PoseCheck, _cause
from ertis_numba.motion.pose_residuals import HeardStep, PoseResiduals
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


def warning(given, **options):
    """Return the warning of a check of poses by reflectors at rest, seen from the true path."""
    return checked(given, **options).warning()


def checked(given, *, count=40, moves=True):
    """Return a check of poses by reflectors at rest, seen from the true path."""
    check = PoseCheck(MOUNTINGS)
    for pulse in range(N_PULSES):
        at = pulse if moves else 0
        pose = PATH[at].real, PATH[at].imag, YAW_RAD[at]
        check.add([seen_from(pose, places_m(count=count), pulse)], given)
    return check


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
    assert f"({N_PULSES - 1} steps compared)" in found
    assert cause in found


def test_motion_without_a_known_cause_is_a_contradiction():
    assert "correct the poses, their times or the mounting" in warning(trajectory(PATH * 2j, YAW_RAD))


def test_echoes_that_show_no_motion_are_named_instead_of_compared():
    check = checked(trajectory(100 * PATH, YAW_RAD), count=1)
    assert check.warning() is None
    wanted = "the poses were not compared with the echoes: they show the motion in 0 of 6 steps, and 4 are needed"
    assert check.note() == wanted
    assert checked(trajectory(PATH, YAW_RAD)).note() is None


def test_motions_below_the_errors_of_the_poses_are_not_compared():
    uncertain = trajectory(PATH, YAW_RAD).replace(covariance=np.tile(np.eye(6), (N_PULSES, 1, 1)))
    check = checked(uncertain)
    assert check.warning() is None
    assert check.note().endswith("the motion is smaller than the errors of echoes and poses")


def test_a_trajectory_for_each_pulse_is_not_compared_and_said():
    check = PoseCheck(MOUNTINGS)
    for pulse in range(N_PULSES):
        pose = PATH[pulse].real, PATH[pulse].imag, YAW_RAD[pulse]
        check.add([seen_from(pose, places_m(), pulse)], trajectory(PATH, YAW_RAD))
    assert check.warning() is None
    assert "nearly every pulse has a trajectory of its own; pass one" in check.note()


def test_a_contradiction_counts_in_stated_deviations_along_one_axis():
    """The same error passes or not by whether the stated deviation of each axis covers it."""
    place = PATH + np.where(np.arange(N_PULSES) % 2, 0.12, 0.0)
    kept = []
    for sd_m in (0.12, 0.01):
        covariance = np.tile(np.diag([sd_m**2, sd_m**2, 1e-6, 1e-6, 1e-6, 1e-4]), (N_PULSES, 1, 1))
        kept.append(warning(trajectory(place, YAW_RAD).replace(covariance=covariance)) is None)
    assert kept == [True, False]


def test_poses_that_stand_still_cost_nothing(monkeypatch):
    added = []
    monkeypatch.setattr(Odometry, "add", lambda _, items: added.append(items))
    check = PoseCheck(MOUNTINGS)
    given = trajectory(np.full(N_PULSES, 1 + 0j), np.zeros(N_PULSES))
    for pulse in range(N_PULSES):
        check.add([seen_from((1.0, 0.0, 0.0), places_m(), pulse)], given)
    assert len(added) == 1
    assert check.warning() is None


def test_frozen_poses_are_found_later():
    check = PoseCheck(MOUNTINGS)
    given = trajectory(np.full(20, 1 + 0j), np.zeros(20))
    for pulse in range(20):
        check.add([seen_from((0.04 * pulse, 0.0, 0.0), places_m(), pulse)], given)
    assert "the echoes contradict the poses" in check.warning()


N_STEPS, STEP_S = 14, 0.125


def drawn_steps(draws):
    """Return measured steps on an arc of changing speed and yaw rate, and the times and poses of its path at 50 Hz."""
    time_s = np.arange(-1.0, (N_STEPS + 8) * STEP_S, 0.02)
    speed_m_s = draws.uniform(0.3, 1.0) * (1 + 0.4 * np.sin(2 * time_s + draws.uniform(0, 6)))
    yaw_rad = np.cumsum(np.radians(60) * np.sin(1.5 * time_s + draws.uniform(0, 6))) * 0.02
    place = np.cumsum(speed_m_s * np.exp(1j * yaw_rad)) * 0.02
    steps, sd = [], np.array([0.015, 0.015, 0.025])
    for number in range(N_STEPS):
        at_s = STEP_S * np.array([number, number + 1])
        begin, end = np.interp(at_s, time_s, place)
        first_rad, last_rad = np.interp(at_s, time_s, yaw_rad)
        middle_rad, half_rad = (first_rad + last_rad) / 2, (last_rad - first_rad) / 2
        way = (end - begin) * np.exp(-1j * middle_rad) / np.sinc(half_rad / np.pi)
        twist = np.array([way.real, way.imag, last_rad - first_rad]) / STEP_S
        ends_ns = (int(each * 1e9) for each in at_s)
        if draws.uniform() < 0.8:
            steps.append(HeardStep(*ends_ns, twist + draws.normal(0, sd), np.diag(sd**2)))
    return steps, time_s, place, yaw_rad


def timed(time_s, place, yaw_rad):
    given = trajectory(place, yaw_rad)
    return given.replace(time_ns=np.round(time_s * 1e9).astype(np.int64))


def test_true_poses_with_usual_errors_are_rarely_accused():
    accused = 0
    for seed in range(200):
        draws = np.random.default_rng([seed, 1])
        steps, time_s, place, yaw_rad = drawn_steps(draws)
        white = draws.normal(0, 0.01 * (seed % 2), (3, len(time_s)))
        scale, heading, late_s = 1 + draws.normal(0, 0.02), draws.normal(0, 0.02), draws.normal(0, 0.02)
        noisy = place * scale + white[0] + 1j * white[1], yaw_rad + heading + white[2]
        every = int(draws.choice([1, 5, 10]))
        given = timed(time_s + late_s, *noisy)
        thinned = timed(time_s[::every] + late_s, *(each[::every] for each in noisy))
        accused += PoseResiduals(steps, thinned if seed % 3 else given).contradicts()
    assert accused <= 2


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda time_s, place, yaw_rad: (time_s, 1j * place.conj(), yaw_rad), "with x and y swapped"),
        (lambda time_s, place, yaw_rad: (time_s, 2 * place, yaw_rad), "too large by a factor of 2"),
        (lambda time_s, place, yaw_rad: (time_s, place, 0 * yaw_rad), "without the turns of the platform"),
        (lambda time_s, place, yaw_rad: (time_s + 0.5, place, yaw_rad), " s late"),
        (lambda time_s, place, yaw_rad: (time_s, place + 0.4 * np.exp(1j * yaw_rad), yaw_rad), "those of a point +0."),
        (lambda time_s, place, yaw_rad: (time_s, place, yaw_rad + 0.25), "° too large in yaw"),
        (
            lambda time_s, place, yaw_rad: (time_s, place, 1.5 * yaw_rad - 0.5 * yaw_rad[50]),
            "turned too far by a factor of 1.",
        ),
        (lambda time_s, place, yaw_rad: (time_s, place, -yaw_rad), "yaw of the opposite sign"),
    ],
    ids=["swapped", "scale", "constant heading", "late", "lever", "heading", "turns", "sign of yaw"],
)
def test_contradictions_are_found_and_named(change, cause):
    n_found = n_named = 0
    for seed in range(8):
        steps, *path = drawn_steps(np.random.default_rng([seed, 2]))
        compared = PoseResiduals(steps, timed(*change(*path)))
        n_found += (is_wrong := compared.contradicts())
        n_named += is_wrong and cause in _cause(compared)
    assert n_found >= 7
    assert n_named >= 6
