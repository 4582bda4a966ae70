"""Places as sensors see them, against closed forms."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.fusion.rig import Emitters, mounted_sensors
from ertis_numba.fusion.sight import Viewers, mirrored, tangents
from ertis_numba.geometry.air import absorption_db_m

AHEAD, TO_THE_LEFT = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
SENSORS = mounted_sensors({"front": ((0.2, 0.0, 0.0), AHEAD), "left": ((0.0, 0.1, 0.0), TO_THE_LEFT)})


def viewers(diameters_m=(0.0, 0.0), flat=(0, 1)):
    model = Emitters(ertis.Settings(), diameters_m)
    return Viewers(SENSORS, dict.fromkeys(range(2), model), flat)


def test_sight_gives_distances_and_directions():
    sight = viewers().sight(np.array([[1.4, 1.6, 0.0]]))
    np.testing.assert_allclose(sight.apart_m, [[2.0, math.hypot(1.4, 1.5)]])
    np.testing.assert_allclose(sight.toward[0, 0], [0.6, 0.8, 0.0])
    np.testing.assert_allclose(sight.depth, [[0.6, 1.5 / math.hypot(1.4, 1.5)]])
    np.testing.assert_allclose(sight.seen, sight.toward)


@pytest.mark.parametrize(("flat", "seen"), [((0, 1), [0.6, 0.8, 0.0]), ((1,), [-0.6, 0.8, 0.0])])
def test_flat_array_sees_places_behind_it_in_front(flat, seen):
    sight = viewers(flat=flat).sight(np.array([[-1.0, 1.6, 0.0]]))
    np.testing.assert_allclose(sight.seen[0, 0], seen, atol=1e-12)
    assert sight.depth[0, 0] == pytest.approx(-0.6)


def test_gain_is_that_of_spherical_spreading_and_absorption():
    """The echo of a place at 2 m, over both paths, is 1/16 of that at 1 m before the absorption of its frequencies."""
    call, air = ertis.Settings().call, ertis.Settings().air
    gain = viewers().sight(np.array([[2.2, 0.0, 0.0], [1.2, 0.0, 0.0]])).gain[:, 0, 0]
    least, most = sorted(absorption_db_m(air, np.array([call.start_frequency_hz, call.stop_frequency_hz])).tolist())
    assert 10 ** (-2 * most / 10) / 16 < gain[0] / gain[1] < 10 ** (-2 * least / 10) / 16
    assert gain[1] == pytest.approx(1.0, rel=1e-9)


def test_gain_of_pistons_is_zero_behind_them():
    sight = viewers((0.012, 0.0)).sight(np.array([[-1.0, 0.0, 0.0]]))
    assert (sight.gain[0, :, 0] == 0).all()
    assert (sight.gain[0, :, 1] > 0).all()
    assert sight.beside_m[0, 0] == pytest.approx(10.9e-3, abs=0.5e-3)
    assert sight.beside_m[0, 1] == 0


@pytest.mark.parametrize(("angle_deg", "split_m"), [(30, 0.0), (45, 0.0), (63, 7.1e-3), (75, 10.2e-3), (90, 10.8e-3)])
def test_path_beside_the_beam_is_as_uncertain_as_the_pulse_is_split(angle_deg, split_m):
    """Maxima of the transform of a piston's spectrum, from 400 frequencies; it is flat near the first split."""
    turn_rad = math.radians(angle_deg)
    place_m = SENSORS[0].translation_m + 1.5 * np.array([math.cos(turn_rad), math.sin(turn_rad), 0.0])
    assert -0.5e-3 < viewers((0.012, 0.0)).sight(place_m[None]).beside_m[0, 0] - split_m < 1.5e-3


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.36, -0.48, 0.8]])
def test_tangents_and_directions_form_right_handed_axes(direction):
    axes = np.stack([direction, *tangents(np.array(direction))])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_mirrored_directions_change_only_their_depth():
    found = mirrored(np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(found, [[-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)
