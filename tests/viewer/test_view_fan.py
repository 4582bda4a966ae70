"""Directions that a picture shows: all around, behind, and no unmeasured ones."""

import math

import numpy as np
import pytest

from ertis_numba.geometry import Fan
from ertis_numba.viewer import Polar, _axes
from tests.files import image
from tests.views import TABLE, brightest


@pytest.mark.parametrize("first_deg", [-180.0, -178.0, -77.0, 0.0])
def test_full_circle_grid_has_no_gap(first_deg):
    made = image(first_deg + np.arange(0.0, 360.0, 2.0))
    level = np.ones_like(made.amplitude)
    level[0] = 1e-4  # between the last and this one is half of what is between them, in dB
    polar = Polar(made, dynamic_range_db=80.0)
    levels = polar.levels(level)

    def seen(azimuth_deg):
        return polar.look(*np.array([[-math.sin(math.radians(azimuth_deg))], [math.cos(math.radians(azimuth_deg))]]))(
            levels
        )

    for azimuth_deg in np.arange(0.0, 360.0, 0.5):
        (found,) = seen(first_deg + azimuth_deg)
        away_deg = min(azimuth_deg, 360.0 - azimuth_deg)
        assert found == pytest.approx(255 * min(1.0, away_deg / 2), abs=2), azimuth_deg
    half = Polar(image(np.linspace(-90, 90, 91)))
    assert len(half.look(np.array([0.0]), np.array([-1.0])).places) == 0


def looking(azimuth_deg):
    """Azimuths that a picture of some directions shows, in whole degrees."""
    polar = Polar(image(azimuth_deg))
    around_rad = np.radians(np.arange(-179.0, 181.0))
    look = polar.look(-2 * np.sin(around_rad), 2 * np.cos(around_rad))
    return set((look.places - 179).tolist())


@pytest.mark.parametrize(
    ("azimuth_deg", "seen_deg"),
    [
        (np.arange(100, 261, 2), {*range(100, 181), *range(-179, -99)}),
        (np.arange(-260, -99, 2), {*range(100, 181), *range(-179, -99)}),
        (np.concatenate([np.arange(-180, -99, 2), np.arange(100, 178)]), {*range(100, 181), *range(-179, -99)}),
        (np.arange(200, 361, 2), set(range(-160, 1))),
        ([-30, 30], {-30, -29, 29, 30}),
        ([-170, 170], {-170, -171, 170, 171}),
        ([-60, -59, -58, 40, 41, 42], {-60, -59, -58, -57, 39, 40, 41, 42}),
        ([-40, -35, -30, *range(-10, 11), 30, 35, 40], {*range(-40, -23), *range(-16, 17), *range(24, 41)}),
        ([-30, -25, -20, *np.arange(-20, 20, 0.5), 20, 25, 30], set(range(-30, 31))),
    ],
)
def test_picture_shows_the_imaged_sector(azimuth_deg, seen_deg):
    assert looking(np.asarray(azimuth_deg, float)) == seen_deg


def test_reflector_behind_is_drawn_at_its_position():
    made = image(np.arange(100.0, 261.0, 2.0))
    across, along = (np.degrees(made.azimuth_rad) - 230) / 4, (made.range_m - 3.0) / 0.03
    amplitude = np.exp(-0.5 * (across[:, None] ** 2 + along**2)).astype(np.float32)
    polar = Polar(made)
    azimuth_deg, range_m = polar.place_of(*brightest(polar.picture(polar.levels(amplitude), TABLE)[:-66]))
    assert azimuth_deg == pytest.approx(-130, abs=0.8)
    assert range_m == pytest.approx(3.0, abs=0.015)


@pytest.mark.parametrize(
    ("azimuth_deg", "rays"),
    [
        (np.arange(100, 261, 2), "+120° +150° +180° −150° −120°"),
        (np.arange(-180, 180, 2), "−150° −120° −90° −60° −30° 0° +30° +60° +90° +120° +150° +180°"),
    ],
)
def test_rays_behind_are_labelled(azimuth_deg, rays, monkeypatch):
    drawn = []
    monkeypatch.setattr(_axes, "ink_of", drawn.append)
    fan = Fan.of(np.radians(azimuth_deg), np.zeros(len(azimuth_deg)), np.array([0.5, 5.0]))
    _axes.draw_axes(_axes.Place.of(fan, 640), fan, 40.0)
    names = [text.get_text() for text in drawn[0].axes[0].texts]
    assert [name for name in names if name.endswith("°")] == rays.split()
