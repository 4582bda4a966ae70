"""Mountings so far apart that sensors share no reflector, as those in centimetres that are read as metres."""

import re

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.settings import Settings
from tests.files import image

TURN = (0.0, 0.0, 0.0, 1.0)
AZIMUTH_DEG = np.linspace(-60.0, 60.0, 41)
LAST_M = 4.0


def mountings(spacing_m):
    return {"front": ((spacing_m, 0.0, 0.4), TURN), "left": ((0.0, 0.0, 0.4), TURN)}


def images(range_m=None):
    made = image(
        AZIMUTH_DEG, np.zeros(41), range_m=np.arange(0.6, LAST_M, 0.01) if range_m is None else range_m, seed=3
    )
    made = made.replace(settings=made.settings.replace("processing.range_m", (0.6, LAST_M)))
    return [made.replace(stamp=Stamp(sensor=name, timestamp_ns=10**18)) for name in mountings(1.0)]


USES = {
    "Fuser": lambda given: ertis.Fuser(given)(images()),
    "Mapper": lambda given: ertis.Mapper(given).add(images(), ((0.0, 0.0, 0.0), TURN)),
    "Odometry": lambda given: ertis.Odometry(given).add(images()),
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize(
    ("spacing_m", "remedy"),
    [
        (40.0, "; if they are in centimetres, divide them by 100,"),
        (283.0, "; if they are in millimetres, divide them by 1000,"),
        (9000.0, "in metres, or use"),
    ],
)
def test_mountings_in_other_units_are_refused(use, spacing_m, remedy):
    message = f"'front' and 'left' are mounted {spacing_m:g} m apart, but images reach [34]"
    with pytest.raises(ertis.ArgumentError, match=f"{message}.*{re.escape(remedy)}"):
        USES[use](mountings(spacing_m))


@pytest.mark.parametrize("use", USES)
def test_sensors_that_share_reflectors_are_used(use):
    USES[use](mountings(7.9))


def test_one_far_sensor_is_named():
    far = mountings(0.2) | {"right": ((0.0, -20.0, 0.4), TURN)}
    with pytest.raises(ertis.ArgumentError, match="sensors 'left' and 'right' are mounted 20 m apart"):
        ertis.Fuser(far)(images())


def test_a_single_sensor_may_be_anywhere():
    cloud = PointCloud(np.ones((1, 3), np.float32), np.ones(1, np.float32), Settings(), Stamp(sensor="front"))
    ertis.Odometry({"front": ((1e4, 0.0, 0.0), TURN)}).add([cloud])
