"""Points of moving sensors, compensated to the start of the measurement."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Call, Processing
from ertis_numba.simulation import Platform, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator


@pytest.mark.parametrize(
    ("velocity_m_s", "yaw_rate_deg_s", "range_m", "azimuth_deg", "call"),
    [
        ((1.4, 0.0), 0.0, 3.0, 0.0, Call()),
        ((0.1, -0.6), -80.0, 2.5, 15.0, Call()),
        ((-1.3, -1.3), 90.0, 2.0, -8.0, Call()),
        ((1.4, 0.0), 0.0, 3.0, 0.0, Call(start_frequency_hz=25e3, stop_frequency_hz=50e3)),
        ((1.4, 0.0), 0.0, 3.0, 0.0, Call(modulation="linear")),
    ],
)
def test_point_of_a_moving_sensor_returns_to_its_place(velocity_m_s, yaw_rate_deg_s, range_m, azimuth_deg, call):
    platform = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (1.0, *velocity_m_s, 0.0, yaw_rate_deg_s)))
    azimuth_rad = math.radians(azimuth_deg)
    place_m = range_m * math.cos(azimuth_rad), range_m * math.sin(azimuth_rad)
    sensor = Sensor(call=call, processing=Processing(range_m=(0.3, 3.5), directions="2d:181"))
    simulator = Simulator(Scene(platform=platform, sensors=(sensor,), points=(Point(position_m=(*place_m, 0.0)),)))
    image = ertis.Pipeline(sensor.settings(), predict=False).process(simulator.render())
    points = ertis.PointExtractor(image.settings, top=1)(image)
    at_rest = ertis.compensate_motion(points, (*velocity_m_s, 0.0), math.radians(yaw_rate_deg_s))

    def errors(cloud):
        x, y, _ = cloud.position_m[0].tolist()
        return abs(math.hypot(x, y) - range_m), abs(math.degrees(math.atan2(y, x)) - azimuth_deg)

    before, after = errors(points), errors(at_rest)
    assert max(before[0] / 1e-3, before[1] / 0.5) > 1.0  # the motion matters
    # Doppler smears linear sweeps, and points are fits of the image of a reflector at rest to all bins around them.
    assert after[0] < (0.25e-3 if call.modulation == "linear" else 0.2e-3)
    assert after[1] < 0.1


@pytest.mark.parametrize(
    ("velocity_m_s", "yaw_rate_rad_s", "message"),
    [
        ((1.0, 0.0), 0.0, r"velocity_m_s has shape \(2,\); use x, y, z"),
        ((math.nan, 0.0, 0.0), 0.0, "velocity_m_s is nan"),
        ((0.0, 0.0, 0.0), 1e3, "yaw_rate_rad_s is 1000"),
    ],
)
def test_unusable_velocities_are_refused(velocity_m_s, yaw_rate_rad_s, message):
    points = ertis.PointCloud(np.zeros((1, 3), np.float32), np.ones(1, np.float32), ertis.Settings())
    with pytest.raises(ArgumentError, match=message):
        ertis.compensate_motion(points, velocity_m_s, yaw_rate_rad_s)
