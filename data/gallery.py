"""Draw and measure the scenes of ``synthetic/scenes`` for ``docs/how-to/gallery.md``, as a part of ``make data``.

Pictures go to ``docs/pictures/gallery``; tables go between the markers ``<!-- scene NAME -->`` and
``<!-- /scene NAME -->``. All else on the page is written by hand.
"""

import io
import itertools
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

import ertis_numba as ertis
from ertis_numba.analysis.compare import errors_of
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effect_plan import EffectPlan, make_plan

ROOT = Path(__file__).parents[1]
SCENES = Path(__file__).parent / "synthetic" / "scenes"
PAGE = ROOT / "docs" / "how-to" / "gallery.md"
PICTURES = ROOT / "docs" / "pictures" / "gallery"
Takes = dict[str, list[tuple[ertis.Energyscape, list[ertis.Reflector]]]]
_MIN_LEVELS_DB = (-10.0, -30.0)
_N_PEAKS = 5  # As many as the command marks by default.
_USUAL_DB = 40.0  # Default of the command.
_MAX_TAKEN = 6  # measurements of each sensor
_MAX_BYTES = 150_000  # size limit of a picture
_SHEET = (1.0, 92)  # share of a figure's width that is shown, and dots per inch
_FRAME = (0.765, 84)  # the same for figures side by side: without colour bar and list
_IN_ORDER = {"microphone_noise": False, "microphone_spread": False, "microphone_faults": False}


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Picture of a scene in the gallery.

    Attributes
    ----------
    frames : tuple of (sensor, index)
        Measurements to draw.
    dynamic_range_db : float
        Range of the colours in dB; 30 by default.
    healthy : bool
        Whether a second picture shows the scene without microphone faults; False by default.
    """

    frames: tuple[tuple[str, int], ...]
    dynamic_range_db: float = 30.0
    healthy: bool = False


SHOWN = {
    "corridor": Shown(frames=(("robot", 0), ("robot", 1), ("robot", 2))),
    "shelf_of_bottles": Shown(frames=(("gripper", 0),), dynamic_range_db=20.0),
    "moving_person": Shown(frames=(("door", 0), ("door", 2), ("door", 4))),
    "two_facing_sensors": Shown(frames=(("west", 0), ("east", 0)), dynamic_range_db=40.0),
    "faulty_array": Shown(frames=(("worn", 0),), healthy=True),
    "moving_platform": Shown(frames=(("front", 0), ("front", 3), ("front", 5))),
    "hall": Shown(frames=(("front", 0), ("right", 0))),
}
"""Pictures of the gallery, in their order on the page."""


def main() -> None:
    """Draw the pictures and write the tables of all scenes, or of scenes named on the command line."""
    PICTURES.mkdir(exist_ok=True)
    for name in sys.argv[1:] or SHOWN:
        scene = ertis.load_scene(SCENES / f"{name}.toml")
        plan = make_plan(scene)
        takes = take(scene, plan)
        stems = [name]
        draw(name, takes, SHOWN[name])
        if SHOWN[name].healthy:
            stems.append(f"{name}_healthy")
            healthy = scene.replace(effects=_IN_ORDER)
            new = take(healthy, make_plan(healthy))
            draw(stems[-1], new, SHOWN[name])
            takes |= {f"{sensor}, as new": shots for sensor, shots in new.items()}
        pictures = [f"![{stem.replace('_', ' ')}](../pictures/gallery/{stem}.png)" for stem in stems]
        text = "\n\n".join([*pictures, command(name, scene, SHOWN[name]), effects_table(plan), errors_table(takes)])
        PAGE.write_text(replaced(PAGE.read_text("utf-8"), f"scene {name}", text), encoding="utf-8")


def take(scene: Scene, plan: EffectPlan) -> Takes:
    """Return the images and the ground truth of the first measurements, by sensor."""
    takes = {}
    for sensor in scene.sensors:
        simulator, pipeline = ertis.Simulator(scene, sensor=sensor.name, plan=plan), ertis.Pipeline(sensor.settings())
        takes[sensor.name] = [
            (pipeline.process(simulator.render(index)), simulator.reflectors(index))
            for index in range(min(scene.count, _MAX_TAKEN))
        ]
    return takes


def draw(stem: str, takes: Takes, shown: Shown) -> None:
    """Draw the picture of a scene."""
    figures = []
    for sensor, index in shown.frames:
        image, _ = takes[sensor][index]
        peaks = ertis.find_peaks(image, top=_N_PEAKS, false_alarm=FALSE_ALARM)
        figures.append(ertis.plot(image, dynamic_range_db=shown.dynamic_range_db, peaks=peaks))
    save(figures, PICTURES / f"{stem}.png")


def command(name: str, scene: Scene, shown: Shown) -> str:
    """Return the line with the command that draws the picture of a scene."""
    sensor, first = shown.frames[0]
    words = ["ertis plot", f"{name}.energy.h5"]
    words += ["--sensor", sensor] if len(scene.sensors) > 1 else []
    words += ["--measurement", str(first)] if first or len(shown.frames) > 1 else []
    words += ["--dynamic-range", f"{shown.dynamic_range_db:g}"] if shown.dynamic_range_db != _USUAL_DB else []
    others = [
        f"`--sensor {each}`" if each != sensor else f"`--measurement {index}`" for each, index in shown.frames[1:]
    ]
    more = f"; then with {' and '.join(others)}" if others else ""
    return f"`{' '.join(words)}`{more}"


def save(figures: Sequence[Figure], path: Path) -> None:
    """Save figures side by side."""
    share, dpi = _SHEET if len(figures) == 1 else _FRAME
    parts = [_raster(figure, dpi) for figure in figures]
    widths = [round(share * part.width) for part in parts]
    strip = Image.new("RGB", (sum(widths), parts[0].height))
    for number, part in enumerate(parts):
        strip.paste(part.crop((0, 0, widths[number], part.height)), (sum(widths[:number]), 0))
    strip.save(path, optimize=True)
    if path.stat().st_size > _MAX_BYTES:  # large pictures have so many colours that 256 of them are enough
        strip.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def _raster(figure: Figure, dpi: int) -> Image.Image:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return Image.open(file).convert("RGB")


def effects_table(plan: EffectPlan) -> str:
    """Return the rows of ``--explain`` for the effects that concern the scene, as Markdown."""
    rows = [
        (
            f"`{verdict.name}`",
            "on" if verdict.on else "off",
            "" if verdict.estimate_db is None else f"{verdict.estimate_db:.2g} dB",
            verdict.reason.replace("|", "\\|"),
        )
        for verdict in plan.verdicts
        if verdict.on or verdict.estimate_db is not None
    ]
    return _table(("effect", "", "change", "why"), "llrl", rows)


def errors_table(takes: Takes) -> str:
    """Return the errors of each sensor for two minimum levels, as Markdown."""
    cells = []
    for sensor, level_db in itertools.product(takes, _MIN_LEVELS_DB):
        errors = errors_of(ertis.compare(image, truth, min_level_db=level_db) for image, truth in takes[sensor])
        cells.append(
            (
                sensor,
                f"−{-level_db:g} dB",
                f"{errors.measurements}",
                f"{errors.matched}",
                f"{errors.missed}",
                f"{errors.spurious}",
                _number(errors.angle_rms_deg, 2, "°"),
                _number(errors.range_bias_m, 1, " mm", 1000),
                _number(errors.range_rms_m, 1, " mm", 1000),
                _number(errors.level_rms_db, 2, " dB"),
            )
        )
    head = ("sensor", "down to", "images", "found", "missed", "spurious", "angle", "range, bias", "range", "level")
    return _table(head, "l" + 9 * "r", cells)


def _number(value: float | None, digits: int, unit: str, scale: float = 1.0) -> str:
    if value is None:
        return "–"
    text = f"{scale * value:.{digits}f}"
    return (text.removeprefix("-") if not float(text) else text.replace("-", "−")) + unit


def _table(head: Sequence[str], align: str, rows: Iterable[Sequence[str]]) -> str:
    rule = [{"l": "---", "r": "---:"}[side] for side in align]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *rows))


def replaced(page: str, marker: str, text: str) -> str:
    """Return a page with the text between two markers replaced."""
    head, begin, rest = page.partition(f"<!-- {marker} -->")
    _, end, tail = rest.partition(f"<!-- /{marker} -->")
    if not (begin and end):
        raise SystemExit(f"the page has no markers for {marker!r}; add <!-- {marker} --> and <!-- /{marker} -->")
    return f"{head}{begin}\n{text}\n{end}{tail}"


if __name__ == "__main__":
    main()
