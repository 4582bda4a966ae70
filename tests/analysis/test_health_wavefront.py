"""Delays of channels are reported only if the envelope and both halves of the band agree."""

from ertis_numba.analysis.health import health
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation import Electronics, Scene, Sensor
from ertis_numba.simulation.render import Simulator


def test_health_ignores_the_start_of_modulators_in_silence():
    """Each modulator starts with a click of its own sign, which other checks take for one wavefront."""
    electronics = Electronics(noise_dbfs=None, modulator_order=3)
    sensor = Sensor(array=Array(layout="eRTIS_v3D1"), recording=Recording(n_samples=65_536), electronics=electronics)
    scene = Scene(seed=41, sensors=(sensor,), effects={"microphone_noise": False})
    assert health(Simulator(scene).render()).faults == {}
