"""Spheres of some wavelengths and near discs, compared with series and integrals."""

import numpy as np
import pytest
import scipy.special
from numpy.testing import assert_allclose

from ertis_numba.simulation import Emitter, Point, Sphere
from tests.scenes import BAND_HZ, EAR, SPEED_M_S, heard, line_array, scene_of, sorted_ways, spectrum_at, vector, ways

WAVE = 2 * np.pi * BAND_HZ / SPEED_M_S
CENTRE_M = np.array([0.4, 0.0, 0.0])


def pair(receiver_m, mouth_m, **more):
    """Sensor that receives sound of an emitter elsewhere."""
    receiver = EAR.replace(position_m=vector(receiver_m), emitter=Emitter(silent=True))
    transmitter = EAR.replace(name="mouth", position_m=vector(mouth_m))
    return scene_of(sensor=receiver, **more).replace(sensors=(receiver, transmitter))


def of_the_call(signal):
    """Spectrum of a signal, relative to that of the call itself."""
    one = heard(scene_of(Point(range_m=0.4, strength_db=0.0), sensor=EAR), "spreading")[0]
    call = 0.4**2 * spectrum_at(one, BAND_HZ) * np.exp(0.8j * WAVE)
    return spectrum_at(signal, BAND_HZ) / call


def series_of_a_sphere(radius_m, first_m, second_m, cos_between, wave):
    """Echo of a rigid sphere between two near points: ``jk Σ (2n+1) j'/h' h(kr₁) h(kr₂) Pₙ``."""
    orders = np.arange(int(wave * radius_m) + 20)

    def hankel(x, *, derivative=False):
        return scipy.special.spherical_jn(orders, x, derivative) - 1j * scipy.special.spherical_yn(
            orders, x, derivative
        )

    size = wave * radius_m
    reflected = scipy.special.spherical_jn(orders, size, derivative=True) / hankel(size, derivative=True)
    terms = (2 * orders + 1) * reflected * scipy.special.eval_legendre(orders, cos_between)
    return 1j * wave * np.sum(terms * hankel(wave * first_m) * hankel(wave * second_m))


@pytest.mark.parametrize("radius_m", [0.001, 0.0015, 0.002, 0.004, 0.01, 0.03])
def test_sphere_echo_matches_the_partial_wave_series(radius_m):
    scene = scene_of(sensor=EAR, spheres=(Sphere(position_m=vector(CENTRE_M), radius_m=radius_m),))
    found = of_the_call(heard(scene, "spreading", "target_size")[0])
    wanted = np.array([series_of_a_sphere(radius_m, 0.4, 0.4, 1.0, wave) for wave in WAVE])
    assert_allclose(found / wanted, 1.0, atol=0.06)  # 0.5 dB: the series of the simulator is one of plane waves


@pytest.mark.parametrize("radius_m", [0.001, 0.003, 0.008])
def test_sphere_bistatic_echo_matches_the_partial_wave_series(radius_m):
    receiver_m, mouth_m = np.array([0.0, 0.0, 0.0]), np.array([0.1, 0.4, 0.0])
    scene = pair(receiver_m, mouth_m, spheres=(Sphere(position_m=vector(CENTRE_M), radius_m=radius_m),))
    silent = pair(receiver_m, mouth_m)
    names = ("spreading", "target_size", "cross_emission")
    echo = heard(scene, *names)[0] - heard(silent, *names)[0]
    first_m, second_m = np.linalg.norm(mouth_m - CENTRE_M), np.linalg.norm(receiver_m - CENTRE_M)
    cos_between = (mouth_m - CENTRE_M) @ (receiver_m - CENTRE_M) / first_m / second_m
    wanted = np.array([series_of_a_sphere(radius_m, first_m, second_m, cos_between, wave) for wave in WAVE])
    assert_allclose(of_the_call(echo) / wanted, 1.0, atol=0.06)


def test_small_sphere_follows_rayleigh_scattering():
    """``5/6 a (ka)²`` for backscattering."""
    scene = scene_of(sensor=EAR, spheres=(Sphere(position_m=(1.0, 0.0, 0.0), radius_m=0.001),))
    for frequency_hz in (2_000.0, 5_000.0, 10_000.0):
        _, amplitude = sorted_ways(scene, "spreading", "target_size", frequency_hz=(frequency_hz,))
        size = 2 * np.pi * frequency_hz / SPEED_M_S * 0.001
        assert abs(amplitude[0]) == pytest.approx(5 / 6 * 0.001 * size**2, rel=0.5 * size**2 + 0.002)


def kirchhoff(radius_m, mouth_m, receiver_m, normal, wave, count=200):
    """Kirchhoff's integral over a disc at the origin, relative to its far-field backscattering."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    places_m = radius_m * (nodes + 1) / 2
    around = 2 * np.pi * np.arange(count) / count
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    points_m = places_m[:, None, None] * (np.cos(around)[:, None] * across + np.sin(around)[:, None] * up)
    legs_m = [np.linalg.norm(points_m - end_m, axis=-1) for end_m in (mouth_m, receiver_m)]
    ends_m = [np.linalg.norm(end_m) for end_m in (mouth_m, receiver_m)]
    falls = ends_m[0] * ends_m[1] / (legs_m[0] * legs_m[1])
    phases = np.exp(-1j * wave * (legs_m[0] + legs_m[1] - sum(ends_m)))
    return np.sum((weights * places_m)[:, None] * falls * phases) / count / radius_m


@pytest.mark.parametrize(
    ("diameter_m", "turned_deg"), [(0.02, 0), (0.02, 10), (0.06, 0), (0.06, 5), (0.1, 0), (0.1, 4), (0.2, 2)]
)
def test_disc_echo_matches_kirchhoffs_integral(diameter_m, turned_deg):
    disc = Point(position_m=vector(CENTRE_M), diameter_m=diameter_m, facing_deg=(180 - turned_deg, 0), strength_db=0.0)
    found = 0.4**2 * of_the_call(heard(scene_of(disc, sensor=EAR), "spreading", "target_size")[0])
    angle = np.radians(180 - turned_deg)
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    ends_m = (-CENTRE_M, -CENTRE_M)
    wanted = np.array([kirchhoff(diameter_m / 2, *ends_m, normal, wave) for wave in WAVE])
    assert_allclose(found * np.exp(0.8j * WAVE), wanted, atol=0.012)


def test_near_disc_echo_differs_between_microphones():
    """For a disc of 10 cm at 40 cm, a microphone 5 cm aside receives much less."""
    receiver = EAR.replace(array=line_array(3, 0.05))
    disc = Point(position_m=vector(CENTRE_M), diameter_m=0.1, facing_deg=(180, 0), strength_db=0.0)
    [echo] = ways(scene_of(disc, sensor=receiver), "target_size", frequency_hz=BAND_HZ)
    for mic, y_m in enumerate((-0.05, 0.0, 0.05)):
        ends_m = (-CENTRE_M, np.array([-0.4, y_m, 0.0]))
        wanted = [kirchhoff(0.05, *ends_m, np.array([-1.0, 0.0, 0.0]), wave) for wave in WAVE]
        assert_allclose(echo.amplitude[0, mic], wanted, atol=0.012)
