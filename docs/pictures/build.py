"""Pictures of the README and of the pages on beamformers and plots, drawn by `make pictures`.

The real measurement comes with the package rtisdev; its code is not imported.
"""

import dataclasses
import importlib.metadata
import io
from pathlib import Path
from typing import Any

from PIL import Image

import ertis_numba as ertis
from ertis_numba import figures

HERE = Path(__file__).parent
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


if __name__ == "__main__":
    real()
    beamformers()
    kinds()
    leak()
