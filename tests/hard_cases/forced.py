"""Scenes with every effect on, and their images; all intermediate results are checked."""

import numpy as np

from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Electronics, Emitter
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from tests.scenes import SENSOR, line_array, only

EIGHT = SENSOR.replace(
    array=line_array(8, 0.004),
    recording=Recording(n_samples=32_768),
    processing=Processing(directions="2d:91", range_m=(0.0, 0.8), wavefront="plane"),
)
ALL_OF_IT = Electronics(
    noise_dbfs=-70,
    microphone_diameter_m=0.002,
    gain_spread_db=0.5,
    delay_spread_s=5e-7,
    dead_channels=(1,),
    stuck_high=(2,),
)
FULL = EIGHT.replace(emitter=Emitter(diameter_m=0.02, direct_sound_db=-40), electronics=ALL_OF_IT)


def forced(scene):
    """Switch every effect of a scene on."""
    return scene.replace(effects=dict.fromkeys(EFFECTS, True))


def image_of(scene, index=0):
    """Render a scene with every effect on, check all intermediate results, and return its image."""
    plan = only(*EFFECTS) if scene.boxes else make_plan(forced(scene))  # planning takes long with many walls
    simulator = Simulator(forced(scene), plan=plan)
    signals, measurement = simulator.signals(index), simulator.render(index)
    assert np.all(np.isfinite(signals))
    for reflector in simulator.reflectors(index):
        numbers = (reflector.azimuth_deg, reflector.elevation_deg, reflector.range_m, reflector.level_db)
        assert np.all(np.isfinite((*numbers, *reflector.velocity_m_s)))
        assert reflector.level_db <= 0 or reflector.emitter  # other sensors may be louder than the strongest echo
        assert reflector.range_m >= 0
    image = Pipeline(simulator.sensor.settings(), predict=False).process(measurement)  # some scenes are silent
    assert np.all(np.isfinite(image.amplitude))
    return image
