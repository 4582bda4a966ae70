"""Every effect of the registry changes the samples of a scene that is made for it."""

import numpy as np
import pytest

from ertis_numba.simulation import Ambient, Electronics, Emitter, Noise, Point, Scene, Sensor, Sonar, Sphere, Tone, Wall
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import snapshot
from tests.scenes import SENSOR, only, scene_of

ASIDE = Point(azimuth_deg=50.0, range_m=0.6)
HERE = {"azimuth_deg": 10.0, "range_m": 0.8}
OTHER = SENSOR.replace(name="other", position_m=(0.0, 0.3, 0.0))


def sight_of(scene, *names):
    return Sight.of(snapshot(scene, scene.sensors[0], 0.0), only(*names).active)


def with_emitter(**keys):
    return SENSOR.replace(emitter=Emitter(**keys))


def with_electronics(**keys):
    return SENSOR.replace(electronics=Electronics(**keys))


SCENES = {
    "spreading": scene_of(ASIDE),
    "emitter_offset": scene_of(ASIDE, sensor=with_emitter(position_m=(0.0, 0.02, 0.0))),
    "cross_emission": Scene(sensors=(SENSOR, OTHER), points=(ASIDE,)),
    "sync_delay": Scene(sensors=(SENSOR, OTHER), points=(ASIDE,)),
    "clock_drift": scene_of(ASIDE, sensor=with_electronics(clock_drift_ppm=80.0)),
    "walls": scene_of(walls=(Wall(position_m=(0.7, 0.0, 0.0), facing_deg=(180.0, 0.0)),)),
    "occlusion": scene_of(ASIDE, walls=(Wall(position_m=(0.2, 0.0, 0.0), facing_deg=(180.0, 0.0)),)),
    "target_size": scene_of(spheres=(Sphere(position_m=(0.7, 0.1, 0.0), radius_m=0.1),)),
    "absorption": scene_of(ASIDE),
    "emitter_response": scene_of(ASIDE, sensor=with_emitter(resonance_hz=40e3)),
    "emitter_directivity": scene_of(ASIDE, sensor=with_emitter(diameter_m=0.02)),
    "microphone_directivity": scene_of(ASIDE, sensor=with_electronics(microphone_diameter_m=0.004)),
    "doppler": scene_of(ASIDE.replace(velocity_m_s=(-1.0, 0.0, 0.0))),
    "direct_sound": scene_of(sensor=with_emitter(direct_sound_db=-30.0)),
    "interference": scene_of(tones=(Tone(frequency_hz=41e3, level_db=-40.0, **HERE),)),
    "ambient_noise": scene_of(ambient=Ambient(level_dbfs=-50.0)),
    "microphone_noise": scene_of(sensor=with_electronics(noise_dbfs=-50.0)),
    "microphone_spread": scene_of(ASIDE, sensor=with_electronics(gain_spread_db=1.0)),
    "microphone_faults": scene_of(sensor=with_electronics(stuck_high=(1,))),
}
MORE_INTERFERENCE = {
    "noise": scene_of(noises=(Noise(level_db=-40.0, **HERE),)),
    "sonar": scene_of(sonars=(Sonar(level_db=-30.0, **HERE),)),
}
MORE_FAULTS = {"dead microphone": scene_of(ASIDE, sensor=with_electronics(dead_channels=(1,)))}
ALSO_ON = {"sync_delay": ("cross_emission",)}
CASES = [
    *SCENES.items(),
    *(("interference", scene) for scene in MORE_INTERFERENCE.values()),
    *(("microphone_faults", scene) for scene in MORE_FAULTS.values()),
]


def test_each_effect_that_can_be_left_out_has_a_scene():
    assert set(SCENES) == {name for name, each in EFFECTS.items() if not each.indispensable}


@pytest.mark.parametrize(("name", "scene"), CASES, ids=[name for name, _ in CASES])
def test_effect_changes_the_samples_of_its_scene(name, scene):
    sensor, others = scene.sensors[0], ALSO_ON.get(name, ())
    without, with_it = (Engine(scene, sensor, only(*others, *names).active).render().data for names in ((), (name,)))
    assert not np.array_equal(without, with_it)


@pytest.mark.parametrize("name", SCENES)
def test_estimate_of_an_effect_is_made_for_its_scene_only(name):
    """An effect applies to its own scene, and not to an empty one."""
    estimate = EFFECTS[name].estimate
    scene, nothing = SCENES[name], Scene(sensors=(Sensor(),))
    assert estimate(sight_of(scene, *ALSO_ON.get(name, ()))) is not None
    assert estimate(sight_of(nothing)) is None
