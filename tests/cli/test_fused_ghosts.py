"""Fused images of random reflectors, rendered by sums of delayed calls: no ghosts, and amplitudes of the points."""

import functools
import math

import numpy as np
import pytest

import ertis_numba as ertis
from tests.small_platforms import images_of, mounted, random_reflectors, rendered, settings_of

NEAR_M = 0.06
APART_M, APART_RAD = 0.12, math.radians(25.0)
KINDS = [(0.0, 42), (0.0, 43), (0.012, 41), (0.012, 42)]


def fused_of(places_m, strength_db, diameter_m, *, seed=0):
    settings, random = settings_of(diameter_m=diameter_m), np.random.default_rng(seed)
    signals = rendered(mounted(), settings, places_m, strength_db, diameter_m=diameter_m, random=random)
    return ertis.fuse(images_of(signals, settings).values(), mounted())


@functools.cache
def fused(diameter_m, seed):
    return fused_of(*random_reflectors(seed), diameter_m, seed=seed)


def foreign_places(places_m):
    """Places in which sensors would show foreign echoes as their own, far from all reflectors: (ghost,) complex128."""
    places = places_m[:, 0] + 1j * places_m[:, 1]
    sensors = [(complex(*place_m[:2]), math.atan2(place_m[1], place_m[0])) for place_m, _ in mounted().values()]
    found = []
    for here, yaw_rad in sensors:
        for there, _ in sensors:
            local = (places - here) * np.exp(-1j * yaw_rad)
            seen = np.arctan2(local.imag, np.abs(local.real))  # A flat array shows sound from behind in front.
            range_m = (np.abs(places - here) + np.abs(places - there)) / 2
            found.append(here + range_m * np.exp(1j * (seen + yaw_rad)))
    ghosts = np.concatenate(found)
    apart = np.abs(np.abs(ghosts[:, None]) - np.abs(places)) > APART_M
    return ghosts[(apart | (np.abs(np.angle(ghosts[:, None] / places)) > APART_RAD)).all(axis=1)]


def highest(image, place):
    """Highest amplitude near a place."""
    cells = image.range_m * np.exp(1j * image.azimuth_rad)[:, None]
    return float(image.amplitude[np.abs(cells - place) < NEAR_M].max(initial=0.0))


def level_db(image, place):
    return 20 * math.log10(max(highest(image, place), 1e-9))


@pytest.mark.parametrize(("diameter_m", "seed"), KINDS)
def test_fused_image_shows_no_foreign_echo_above_minus_20_db(diameter_m, seed):
    places_m, _ = random_reflectors(seed)
    image = fused(diameter_m, seed).image
    strongest_db = max(level_db(image, complex(*place_m[:2])) for place_m in places_m)
    ghosts = foreign_places(places_m)
    assert len(ghosts) > 50
    assert max(level_db(image, place) for place in ghosts) < strongest_db - 20


@pytest.mark.parametrize(("diameter_m", "seed"), KINDS)
def test_fused_image_has_the_amplitude_of_confirmed_points(diameter_m, seed):
    found = fused(diameter_m, seed)
    points = found.points.only(found.points.confirmed)
    assert len(points) >= 5
    for place_m, amplitude in zip(points.position_m.tolist(), points.amplitude.tolist(), strict=True):
        level = level_db(found.image, complex(*place_m[:2]))
        assert level == pytest.approx(20 * math.log10(amplitude), abs=0.5), place_m


@pytest.mark.parametrize(("diameter_m", "seed"), KINDS)
def test_fused_image_shows_all_reflectors_of_random_strength(diameter_m, seed):
    places_m, strength_db = random_reflectors(seed)
    image = fused(diameter_m, seed).image
    levels_db = np.array([level_db(image, complex(*place_m[:2])) for place_m in places_m]) - strength_db
    assert levels_db.min() > np.median(levels_db) - 10
