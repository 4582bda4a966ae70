"""Error budgets over random settings and scenes.

Each image must keep its budget, or the command must warn on stderr and in the file.
"""

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_bench import machine
from ertis_bench.error_trials.random_settings import DrawLimits, recorded
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.network.processes import ask
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline import verification
from ertis_numba.settings import Accuracy, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS, BeamformerName, WeightingName
from ertis_numba.storage import open_energyscapes, write_recording

__all__ = ["FORMS", "form", "measurement_of", "run", "tried"]

_FLOOR_DB: Final = -100.0  # Below this level, rounding in single precision dominates the error.
_DIRECTIONS: Final = 24  # compared with the exact image
_PLAIN: Final[tuple[BeamformerName, WeightingName]] = ("delay_and_sum", "none")
_COMBINATIONS: Final[tuple[tuple[BeamformerName, WeightingName], ...]] = (
    *(3 * [_PLAIN]),
    ("delay_and_sum", "coherence_factor"),
    ("dmas", "none"),
    ("capon", "none"),
)
_WEIGHTED: Final = 3  # One of so many images of other beamformers has the coherence factor as well.
_SCENES: Final = ("quiet", "loud", "direct sound", "hum", "one echo", "echoes")

_GROUPS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "all": lambda _: True,
    "PDM": lambda row: bool(row["pdm"]),
    "PCM": lambda row: not row["pdm"],
    "one microphone": lambda row: bool(row["microphones"] == 1),
    **{f"`{name}`": lambda row, name=name: row["beamformer"] == name for name in BEAMFORMERS},  # type: ignore[misc]
    **{f"`{name}`": lambda row, name=name: row["weighting"] == name for name in WEIGHTINGS if name != "none"},  # type: ignore[misc]
    **{f"scene: {name}": lambda row, name=name: row["scene"] == name for name in _SCENES},  # type: ignore[misc]
}


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Process ``count`` random recordings through the command line, and return the report."""
    rows: list[dict[str, Any]] = []
    refused = 0
    each = seed
    while len(rows) < count:
        row = tried(each)
        if row is None:
            refused += 1
        else:
            rows.append(row)
            say(
                "{seed}: {beamformer}, {microphones} microphones, {scene}: {outcome}, error {error_db:.1f} dB, "
                "predicted {predicted_db:.1f} dB, budget {budget_db:.1f} dB".format_map(row)
            )
        each += 1
    return {"machine": machine.describe(), "count": count, "seed": seed, "refused": refused, "rows": rows}


def tried(seed: int) -> dict[str, Any] | None:
    """Return the result for one random recording, or None if its settings have no plan or its image is silent."""
    measurement, scene = measurement_of(seed)
    settings = measurement.settings
    with tempfile.TemporaryDirectory() as folder:
        recording, target = Path(folder) / "rec.h5", Path(folder) / "image.h5"
        write_recording(recording, [measurement])
        done = ask("process", str(recording), "-o", str(target), "--device", "cpu", "--quiet")
        if done.returncode:
            if "max_error_db" in done.stderr and "smallest error" in done.stderr:
                return None
            raise ArgumentError(f"seed {seed}: ertis process ended with {done.returncode}: {done.stderr}")
        with open_energyscapes(target) as images:
            image = images[0]
            predicted_db, stored = images.predicted_error_db, images.error_warning
    if not np.any(image.amplitude):
        return None
    # Predictions for adaptive beamformers come from a sample of the directions. Comparing all directions also
    # tests that sample.
    if not settings.processing.is_adaptive:
        chosen, weights = verification.sampled(np.square(image.amplitude, dtype=np.float64).sum(axis=1), _DIRECTIONS)
    else:
        chosen, weights = np.arange(len(image.amplitude)), np.ones(len(image.amplitude))
    verifier, ranges = verification.ExactImage(image, measurement), np.arange(image.amplitude.shape[1])
    exact = np.stack([verifier.amplitudes(direction, ranges) for direction in chosen.tolist()])
    scale = np.sqrt(weights)[:, None]
    error_db = verification.error_db(scale * image.amplitude[chosen], scale * exact)
    warned = bool(stored) and stored in done.stderr
    kept = error_db <= settings.accuracy.max_error_db
    return {
        "seed": seed,
        "scene": scene,
        "pdm": settings.recording.is_pdm,
        "microphones": int(microphones(settings.array).enabled.sum()),
        "beamformer": settings.processing.beamformer,
        "weighting": settings.processing.weighting,
        "budget_db": settings.accuracy.max_error_db,
        "error_db": error_db,
        "predicted_db": predicted_db,
        "audible": error_db > _FLOOR_DB,
        "outcome": ("kept, warned" if warned else "kept") if kept else "warned" if warned else "missed",
    }


def measurement_of(seed: int) -> tuple[Measurement, str]:
    """Return a random measurement and the name of its scene."""
    random = np.random.default_rng([seed, 16])
    scene = str(random.choice(_SCENES))
    settings = _settings(random)
    return Measurement(_words(random, settings, scene), settings), scene


def _settings(random: np.random.Generator) -> Settings:
    pdm = bool(random.integers(2))
    array = _array(random)
    low_hz = float(random.uniform(15e3, 40e3))
    call = Call(
        start_frequency_hz=float(random.uniform(1.3 * low_hz, 80e3)),
        stop_frequency_hz=low_hz,
        duration_s=float(random.uniform(0.5e-3, 3e-3)),
    )
    if pdm:
        recording, step = Recording(sample_rate_hz=4.5e6, n_samples=54_000), int(random.choice([40, 60, 100]))
    else:
        encoding: Literal["int16", "float32"] = "int16" if random.integers(2) else "float32"
        recording = Recording(sample_rate_hz=450e3, n_samples=5_400, encoding=encoding)
        step = int(random.choice([4, 6, 10]))
    first_m = float(random.uniform(0.3, 0.8))
    beamformer, weighting = _COMBINATIONS[random.integers(len(_COMBINATIONS))]
    n_mics = len(microphones(array).enabled_positions_m)
    if n_mics < DrawLimits().max_mics and beamformer == "dmas" and n_mics < 2:
        beamformer = "delay_and_sum"
    # A generator of its own, so that the seeds of former reports still give the same settings otherwise.
    if beamformer in {"dmas", "capon"} and random.spawn(1)[0].integers(_WEIGHTED) == 0:
        weighting = "coherence_factor"
    spherical = (beamformer, weighting) == _PLAIN and random.integers(3) == 0
    return Settings(
        array=array,
        call=call,
        recording=recording,
        processing=Processing(
            directions=f"{random.choice(['2d', '3d'])}:{random.integers(2, 120)}",
            range_m=(first_m, float(random.uniform(first_m + 0.1, 1.4))),
            range_decimation=step,
            wavefront="spherical" if spherical else "plane",
            beamformer=beamformer,
            weighting=weighting,
            dmas_order=int(random.integers(2, min(8, max(2, n_mics)) + 1)),
            snapshots=int(random.integers(1, 9)),
            diagonal_loading=float(10 ** random.uniform(-3, 1)),
        ),
        accuracy=Accuracy(max_error_db=float(random.choice([-20.0, -35.0, -35.0, -60.0, random.uniform(-100, -20)]))),
    )


def _array(random: np.random.Generator) -> Array:
    """Return a shipped layout, or 1 to 64 microphones at random positions."""
    if random.integers(3) == 0:
        return Array(layout=str(random.choice(["eRTIS_v3D1", "eRTIS_v2", "uRTIS_v1"])))
    n_mics = int(random.choice([1, 1, 2, 3, int(random.integers(4, 65))]))
    places_m = random.uniform(-0.03, 0.03, (n_mics, 3)) * [0, 1, 1]
    if n_mics == 1 and random.integers(2):
        places_m[:] = 0.0
    return Array(layout="random", positions_m=tuple(map(tuple, places_m.tolist())), word_bits=64)


def _words(random: np.random.Generator, settings: Settings, scene: str) -> NDArray[Any]:
    """Return the words of a scene with echoes in the window.

    Some scenes add louder sound outside of the window or of the band.
    """
    layout, recording, call = microphones(settings.array), settings.recording, settings.call
    speed_m_s = sound_speed_m_s(settings.air)
    time_s = np.arange(recording.n_samples) / recording.sample_rate_hz
    positions_m = np.zeros((len(layout.enabled), 3))
    positions_m[layout.enabled] = layout.enabled_positions_m
    noise = {"quiet": -3.5, "loud": -0.7}.get(scene, -5.0)
    signals = 10**noise * random.standard_normal((len(positions_m), recording.n_samples))
    first_m, last_m = settings.processing.range_m
    n_echoes = {"one echo": 1, "echoes": int(random.integers(2, 10)), "loud": 3}.get(scene, int(random.integers(0, 3)))
    level = 0.7 / max(1, n_echoes) if scene in {"one echo", "echoes", "loud"} else 10 ** random.uniform(-4.5, -2)
    for _ in range(n_echoes):
        toward = random.standard_normal(3) + np.array([1.5, 0.0, 0.0])
        range_m = random.uniform(first_m, last_m)
        place_m = range_m * toward / np.linalg.norm(toward)
        arrival_s = (range_m + np.linalg.norm(place_m - positions_m, axis=1)) / speed_m_s
        signals += level * np.stack([call_at(call, time_s - late_s) for late_s in arrival_s])
    if scene == "direct sound":
        signals += 0.8 * call_at(call, time_s - 0.2e-3)
    if scene == "hum":
        signals += 0.8 * np.sin(2 * math.pi * random.uniform(50, 5000) * time_s)
    return recorded(random, np.clip(signals, -1, 1), settings)


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    header = [
        "settings",
        "tried",
        "budget kept",
        "exceeded, warned",
        "exceeded without a warning",
        "unnecessary warning",
    ]
    return (
        f"{table(header, list(_lines(report['rows'])))}\n\n{report['count']} random settings from seed "
        f"{report['seed']}. {report['refused']} other settings were skipped, because they have no plan for their "
        "budget or a silent image. Errors are relative to the independent float64 image. They cover all directions for "
        f"adaptive beamformers, and up to {_DIRECTIONS} directions for delay-and-sum, chosen with a preference for "
        "bright ones. "
        f"{sentence(report['machine'])}"
    )


def _lines(rows: Sequence[dict[str, Any]]) -> Iterator[list[str]]:
    for name, belongs in _GROUPS.items():
        outcomes = [row["outcome"] for row in rows if row["audible"] and belongs(row)]
        kept = outcomes.count("kept") + outcomes.count("kept, warned")
        counts = (kept, outcomes.count("warned"), outcomes.count("missed"), outcomes.count("kept, warned"))
        yield [name, str(len(outcomes)), *map(str, counts)]


FORMS = {"budgets": form}
"""Forms of the table, by the name in its markers."""
