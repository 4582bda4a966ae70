"""Pictures of the README and of the documentation, drawn by `make pictures`.

The real measurement comes with the package rtisdev; its code is not imported.
"""

import dataclasses
import importlib.metadata
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba import figures

HERE = Path(__file__).parent
LAP, LAP_STEP, SHOWN_PULSE = 423, 6, 60
"""Pulses of the first lap of the hall, of which every sixth is mapped, and the one whose image is drawn."""
BEAMFORMERS: dict[str, dict[str, Any]] = {
    "Delay-and-sum": {},
    "Coherence factor": {"weighting": "coherence_factor"},
    "DMAS of order 2": {"beamformer": "dmas"},
    "Capon": {"beamformer": "capon"},
}
"""Settings that each picture changes, by its heading."""


def real() -> None:
    """Draw the real measurement in 181 directions with its five strongest reflectors."""
    raw = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    settings = ertis.Settings.from_preset("default_25_50")
    settings = settings.replace(processing=settings.processing.replace(directions="2d:181", range_m=(0.8, 5.0)))
    (measurement,) = ertis.open_raw(str(raw), settings, sensor="eRTIS")
    image = ertis.Pipeline(settings).process(measurement)
    ertis.plot(image, peaks=ertis.find_peaks(image, top=5)).savefig(HERE / "real.png")


def beamformers() -> None:
    """Draw the synthetic reflectors with each beamformer, in two rows of two."""
    with ertis.open_recording(HERE.parents[1] / "data" / "synthetic" / "reflectors.h5") as recording:
        measurement = recording[0]
    parts = []
    for name, options in BEAMFORMERS.items():
        settings = measurement.settings
        processing = settings.processing.replace(directions="2d:361", **options)
        pipeline = ertis.Pipeline(settings.replace(processing=processing))
        figure = ertis.plot(pipeline.process(measurement), dynamic_range_db=50)
        figure.texts[0].set_text(name)
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=70)
        parts.append(Image.open(file).convert("RGB"))
    width, height = round(0.76 * parts[0].width), parts[0].height  # without the common colour bar
    sheet = Image.new("RGB", (width + parts[0].width, 2 * height))
    for place, part in enumerate(parts):
        row, column = divmod(place, 2)
        sheet.paste(part.crop((0, 0, part.width if column else width, height)), (column * width, row * height))
    sheet.save(HERE / "beamformers.png", optimize=True)


def leak() -> None:
    """Draw the acoustic map of a leak, the mean of ten measurements."""
    scene = ertis.load_scene(HERE.parents[1] / "data" / "synthetic" / "scenes" / "leak.toml")
    measurements = [ertis.render(scene, number) for number in range(10)]
    settings = measurements[0].settings.replace("passive.averages", len(measurements))
    with ertis.AcousticCamera(settings) as camera:
        (found,) = camera.process_many(dataclasses.replace(each, settings=settings) for each in measurements)
    figures.acoustic_map(found, band_hz=(50e3, 80e3), dynamic_range_db=20).savefig(HERE / "leak.png", dpi=80)


def kinds() -> None:
    """Draw each kind of plot of the synthetic reflectors on one sheet."""
    takes = {}
    for name in ("reflectors", "reflectors_3d"):
        with ertis.open_recording(HERE.parents[1] / "data" / "synthetic" / f"{name}.h5") as recording:
            takes[name] = recording[0]
    solid = ertis.Pipeline(takes["reflectors_3d"].settings).process(takes["reflectors_3d"])
    drawn = (
        figures.plot(solid, peaks=ertis.find_peaks(solid, top=5)),
        figures.slices(solid, height_m=0.3, left_m=0.4),
        figures.signals(takes["reflectors"]),
        figures.array(takes["reflectors"].settings),
    )
    parts = []
    for figure in drawn:
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=1000 / figure.get_figwidth())  # 1000 pixels wide
        parts.append(Image.open(file).convert("RGB"))
    heights = [max(part.height for part in parts[row : row + 2]) for row in (0, 2)]
    sheet = Image.new("RGB", (2000, sum(heights)), parts[0].getpixel((0, 0)))
    for number, part in enumerate(parts):
        row, column = divmod(number, 2)
        sheet.paste(part, (1000 * column, sum(heights[:row])))
    sheet.quantize(256, dither=Image.Dither.NONE).save(HERE / "kinds.png", optimize=True)


def platform() -> None:
    """Draw a fused pulse in the hall and the map of its first lap, both with the true reflectors as small dots."""
    scene = ertis.load_scene(HERE.parents[1] / "data" / "synthetic" / "scenes" / "hall.toml")
    simulators = {each.name: ertis.Simulator(scene, sensor=each.name) for each in scene.sensors}
    pipelines = {each.name: ertis.Pipeline(each.settings()) for each in scene.sensors}
    mountings = {each.name: (each.position_m, each.quaternion()) for each in scene.sensors}
    mapper, path = ertis.Mapper(mountings, cell_m=0.05), scene.platform.trajectory(np.arange(LAP) / scene.rate_hz)
    for number in range(0, LAP, LAP_STEP):
        images = [pipelines[name].process(simulators[name].render(number)) for name in simulators]
        pose = path.position_m[number], path.rotation_xyzw[number]
        mapper.add(images, (tuple(pose[0].tolist()), tuple(pose[1].tolist())))
        if number == SHOWN_PULSE:
            fused, place = ertis.fuse(images, mountings), pose
    true_m = np.array([point.position_m for point in scene.points])
    polar = figures.plot(fused.image, dynamic_range_db=30, peaks=ertis.find_peaks(fused.image, top=None))
    seen_m = Rotation.from_quat(place[1]).inv().apply(true_m - place[0])
    seen_m = seen_m[np.hypot(*seen_m[:, :2].T) < fused.image.range_m[-1]]
    polar.axes[0].plot(-seen_m[:, 1], seen_m[:, 0], ".", color="white", markersize=2.5, scalex=False, scaley=False)
    above = figures.occupancy(mapper.map, trajectory=path, theme="dark")
    above.axes[0].plot(*true_m[:, :2].T, ".", color="#00aaff", markersize=1.5, scalex=False, scaley=False)
    parts = []
    for figure in (polar, above):
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=1000 / figure.get_figwidth())
        parts.append(Image.open(file).convert("RGB"))
    height = max(part.height for part in parts)
    sheet = Image.new("RGB", (2000, height), parts[0].getpixel((0, 0)))
    for number, part in enumerate(parts):
        sheet.paste(part, (1000 * number, (height - part.height) // 2))
    sheet.quantize(256, dither=Image.Dither.NONE).save(HERE / "platform.png", optimize=True)


if __name__ == "__main__":
    real()
    platform()
    beamformers()
    kinds()
    leak()
