"""Apparent range of reflectors when the emitter is beside the array, as stated in docs/how-to/own-array.md."""

import math

import numpy as np
import pytest

from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Emitter, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator
from tests.scenes import only

SHORT = {"processing": Processing(directions="2d:181", range_m=(0.3, 1.7)), "recording": Recording(n_samples=65_536)}


@pytest.mark.parametrize("emitter_m", [(0.0, 0.0, -0.06), (0.0, 0.06, 0.0), (-0.02, -0.05, 0.04)])
@pytest.mark.parametrize(("azimuth_deg", "range_m"), [(0, 0.6), (50, 0.6), (-70, 1.5)])
def test_emitter_beside_array_shifts_ranges_as_documented(emitter_m, azimuth_deg, range_m):
    angle = math.radians(azimuth_deg)
    toward = np.array([math.cos(angle), math.sin(angle), 0.0])
    array = Sensor(name="array", emitter=Emitter(silent=True), **SHORT)
    beside = Sensor(name="beside", position_m=emitter_m, **SHORT)
    scene = Scene(
        sensors=(array, beside),
        points=(Point(position_m=tuple(range_m * toward), strength_db=0.0),),
        effects={"cross_emission": True, "sync_delay": False},
    )
    simulator = Simulator(scene, sensor="array", plan=only("spreading", "cross_emission"))
    image = Pipeline(array.settings(), predict=False).process(simulator.render())
    direction, place = np.unravel_index(image.amplitude.argmax(), image.amplitude.shape)
    along_m, square_m2 = float(toward @ emitter_m), float(np.dot(emitter_m, emitter_m))
    longer_m = -along_m / 2 + (square_m2 - along_m**2) / (4 * range_m)
    assert math.degrees(image.azimuth_rad[direction]) == pytest.approx(azimuth_deg, abs=0.6)
    assert image.range_m[place] == pytest.approx(range_m + longer_m, abs=0.0025)  # ranges are 3.8 mm apart
