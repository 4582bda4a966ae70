"""Draw and measure the scenes of ``synthetic/scenes`` for ``docs/how-to/gallery.md``, as a part of ``make data``.

Pictures go to ``docs/pictures/gallery``. They are the outputs of the commands beside them, smaller and with fewer
colours. Commands and tables go between the markers ``<!-- scene NAME -->`` and ``<!-- /scene NAME -->``. All else on
the page is written by hand.
"""

import contextlib
import itertools
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner
from ertis_cli.main import cli
from PIL import Image

import ertis_numba as ertis
from ertis_numba.analysis.compare import errors_of
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effect_plan import EffectPlan, make_plan

ROOT = Path(__file__).parents[1]
SCENES = Path(__file__).parent / "synthetic" / "scenes"
PAGE = ROOT / "docs" / "how-to" / "gallery.md"
PICTURES = ROOT / "docs" / "pictures" / "gallery"
Takes = dict[str, list[tuple[ertis.Energyscape, list[ertis.Reflector]]]]
_MIN_LEVELS_DB = (-10.0, -30.0)
_USUAL_DB = 40.0  # Default of the command.
_MAX_TAKEN = 6  # measurements of each sensor
_WIDTHS_PX = {1600: 920, 2240: 1288}  # of the pictures on the page, by the widths of the command's


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Picture of a scene in the gallery.

    Attributes
    ----------
    frames : tuple of (sensor, index)
        Measurements to draw.
    dynamic_range_db : float
        Range of the colours in dB; 30 by default.
    without : str
        Word whose lines the scene of further pictures lacks; no such pictures by default.
    """

    frames: tuple[tuple[str, int], ...]
    dynamic_range_db: float = 30.0
    without: str = ""


SHOWN = {
    "corridor": Shown(frames=(("robot", 0), ("robot", 1), ("robot", 2))),
    "shelf_of_bottles": Shown(frames=(("gripper", 0),), dynamic_range_db=20.0),
    "moving_person": Shown(frames=(("door", 0), ("door", 2), ("door", 4))),
    "two_facing_sensors": Shown(frames=(("west", 0), ("east", 0)), dynamic_range_db=40.0),
    "faulty_array": Shown(frames=(("worn", 0),), without="electronics"),
    "moving_platform": Shown(frames=(("front", 0), ("front", 3), ("front", 5))),
    "hall": Shown(frames=(("front", 0), ("right", 0))),
}
"""Pictures of the gallery, in their order on the page."""


def main() -> None:
    """Draw the pictures and write the tables of all scenes, or of scenes named on the command line."""
    PICTURES.mkdir(exist_ok=True)
    for name in sys.argv[1:] or SHOWN:
        path, shown = SCENES / f"{name}.toml", SHOWN[name]
        scene = ertis.load_scene(path)
        plan = make_plan(scene)
        takes = take(scene, plan)
        parts = [pictures(name, commands(name, scene, shown), takes)]
        if shown.without:
            changed = without(path, shown.without)
            new = take(changed, make_plan(changed))
            parts += [
                f"The same scene as new (`grep -v {shown.without} {name}.toml > as_new.toml`):",
                pictures("as_new", commands("as_new", changed, shown), new),
            ]
            takes |= {f"{sensor}, as new": shots for sensor, shots in new.items()}
        text = "\n\n".join([*parts, effects_table(plan), errors_table(takes)])
        PAGE.write_text(replaced(PAGE.read_text("utf-8"), f"scene {name}", text), encoding="utf-8")


def without(path: Path, word: str) -> Scene:
    """Return a scene without the lines that contain a word."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    with tempfile.TemporaryDirectory() as folder:
        changed = Path(folder) / "as_new.toml"
        changed.write_text("".join(line for line in lines if word not in line), "utf-8")
        return ertis.load_scene(changed)


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


def commands(name: str, scene: Scene, shown: Shown) -> list[str]:
    """Return the command that draws each picture of a scene."""
    found = []
    for sensor, index in shown.frames:
        words = ["ertis plot", f"{name}.energy.h5"]
        words += ["--sensor", sensor] if len(scene.sensors) > 1 else []
        words += ["--measurement", str(index)] if scene.count > 1 else []
        words += ["--dynamic-range", f"{shown.dynamic_range_db:g}"] if shown.dynamic_range_db != _USUAL_DB else []
        found.append(" ".join(words))
    return found


def pictures(name: str, lines: Sequence[str], takes: Takes) -> str:
    """Run the commands of a scene on its images, store their pictures, and return both as Markdown, side by side."""
    stems = [name] if len(lines) == 1 else [f"{name}_{number}" for number in range(1, len(lines) + 1)]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        ertis.write_energyscapes(f"{name}.energy.h5", (image for shots in takes.values() for image, _ in shots))
        for stem, line in zip(stems, lines, strict=True):
            done = CliRunner().invoke(cli, [*line.split()[1:], "-o", f"{stem}.png"])
            if done.exit_code:
                raise SystemExit(f"{line}: {done.stderr}")
            save(Image.open(f"{stem}.png"), PICTURES / f"{stem}.png")
    shown = [f"![{stem.replace('_', ' ')}](../pictures/gallery/{stem}.png)" for stem in stems]
    if len(lines) == 1:
        return f"{shown[0]}\n\n`{lines[0]}`"
    return _table(shown, "l" * len(shown), [[f"`{line}`" for line in lines]])


def save(drawn: Image.Image, path: Path) -> None:
    """Save a picture at the width that the page shows; 256 colours are enough for it."""
    width = _WIDTHS_PX[drawn.width]
    small = drawn.convert("RGB").resize((width, round(width * drawn.height / drawn.width)), Image.Resampling.LANCZOS)
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)


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
