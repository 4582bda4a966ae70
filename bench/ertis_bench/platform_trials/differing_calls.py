"""Fusion of sensors whose calls differ, with and without an image for each pair of emitter and receiver."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ertis_bench.markdown import table
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, N_REFLECTORS, platform_scene, random_reflectors
from ertis_numba.frames import Energyscape, Measurement, PointCloud
from ertis_numba.fusion import Fuser
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Call
from ertis_numba.simulation import Scene, pulse
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.render import Simulator

__all__ = ["compared", "form", "points_of", "run"]

_CALLS: Final = {
    name: Call(start_frequency_hz=1e3 * start_khz, stop_frequency_hz=1e3 * stop_khz)
    for name, (start_khz, stop_khz) in {
        "front": (50, 25),
        "left": (25, 50),
        "back": (80, 50),
        "right": (50, 80),
    }.items()
}
_FOUND_M: Final = 0.1
_SPURIOUS_M: Final = 0.15


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Return errors of points with equal calls, with different ones, and with an image for each pair of these."""
    found = []
    for diameter_m in EMITTERS_M:
        for calls in ("equal", "different", "different, an image for each pair"):
            errors, spurious, n_images = [], 0, 0
            for number in range(seed, seed + count):
                scene = platform_scene(number, random_reflectors(number), diameter_m)
                if calls != "equal":
                    scene = scene.replace(sensors=tuple(each.replace(call=_CALLS[each.name]) for each in scene.sensors))
                cloud, n_images = points_of(scene, diameter_m, with_pairs=calls.endswith("pair"))
                here, others = compared(cloud, scene)
                errors += here
                spurious += others
            say(f"{calls} calls, emitters of {1000 * diameter_m:g} mm: {spurious} points without a reflector")
            found.append(
                {
                    "diameter_m": diameter_m,
                    "calls": calls,
                    "n_images": n_images,
                    "rms_m": float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan"),
                    "located": len(errors),
                    "reflectors": count * N_REFLECTORS,
                    "spurious": spurious,
                }
            )
    return {"count": count, "seed": seed, "calls": found, "suppression_db": _suppression_db()}


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    head = ["emitters", "calls", "images per pulse", "position RMS", "reflectors located", "points without a reflector"]
    rows = [
        [
            f"{1000 * row['diameter_m']:g} mm" if row["diameter_m"] else "omnidirectional",
            row["calls"],
            str(row["n_images"]),
            f"{1000 * row['rms_m']:.1f} mm",
            f"{row['located']} of {row['reflectors']}",
            str(row["spurious"]),
        ]
        for row in report["calls"]
    ]
    low_db, high_db = report["suppression_db"]
    return (
        f"{table(head, rows)}\n\n{report['count']} scenes of {N_REFLECTORS} reflectors from seed {report['seed']}, "
        "four sensors. Different calls sweep from 50 to 25 kHz, 25 to 50 kHz, 80 to 50 kHz and 50 to 80 kHz. A point "
        f"within {100 * _FOUND_M:g} cm locates a reflector; points {100 * _SPURIOUS_M:g} cm or more from all "
        f"reflectors have none. A matched filter lowers the peak of another call by {low_db:.1f} to {high_db:.1f} dB."
    )


def _suppression_db() -> tuple[float, float]:
    """Return the least and the largest suppression of a call's peak by the matched filter of another one."""
    settings = platform_scene(0, (), 0.0).sensors[0].settings()
    peaks_db = [
        -20 * np.log10(np.abs(pulse.matched(settings.replace(call=own), other)).max())
        for own in _CALLS.values()
        for other in _CALLS.values()
        if own != other
    ]
    return float(min(peaks_db)), float(max(peaks_db))


def points_of(scene: Scene, diameter_m: float, *, with_pairs: bool) -> tuple[PointCloud, int]:
    """Return the points of a scene, and the number of images.

    The image of a pair is that of a further, silent sensor at the place of the receiver.
    """
    mountings = {each.name: (each.position_m or (), each.quaternion().tolist()) for each in scene.sensors}
    images, silent, plan = [], [], make_plan(scene)
    for sensor in scene.sensors:
        measurement = Simulator(scene, sensor=sensor.name, plan=plan).render(0)
        for each in [measurement, *(_foreign(measurement, scene) if with_pairs else ())]:
            name = each.stamp.sensor
            if name != sensor.name:
                mountings[name] = mountings[sensor.name]
                silent.append(name)
            images.append(_image(each))
    return Fuser(mountings, emitter_diameter_m=diameter_m, silent=silent)(images).points, len(images)


def _foreign(measurement: Measurement, scene: Scene) -> Iterator[Measurement]:
    """Yield the measurement with the call of each other sensor."""
    stamp, settings = measurement.stamp, measurement.settings
    for other in scene.sensors:
        if other.name != stamp.sensor:
            name = f"{stamp.sensor}.{other.name}"
            yield replace(measurement, settings=settings.replace(call=other.call), stamp=replace(stamp, sensor=name))


def _image(measurement: Measurement) -> Energyscape:
    with Pipeline(measurement.settings, predict=False) as pipeline:
        return pipeline.process(measurement)


def compared(cloud: PointCloud, scene: Scene) -> tuple[list[float], int]:
    """Return the errors of reflectors that points locate, and the number of points without a reflector."""
    places_m = np.array([point.position_m for point in scene.points])[:, :2]
    apart_m = np.linalg.norm(cloud.position_m[:, None, :2].astype(np.float64) - places_m, axis=2)
    nearest_m = apart_m.min(axis=0, initial=np.inf)
    return nearest_m[nearest_m < _FOUND_M].tolist(), int(np.sum(apart_m.min(axis=1) > _SPURIOUS_M))
