"""Costs of the kernels, from which the planner predicts the time of each stage: published or measured here."""

import functools
import hashlib
import json
import logging
import math
import os
import platform
import tempfile
import time
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
import platformdirs
from numpy.typing import NDArray

from ertis_numba.base.forks import ForkSafeLock
from ertis_numba.chain.nominal_costs import NOMINAL_COSTS
from ertis_numba.kernels import KernelSet, fft

__all__ = [
    "PLAN_COSTS",
    "UNITS",
    "Costs",
    "PlanCosts",
    "Work",
    "cache_file",
    "measure",
    "measured_costs",
    "nominal_costs",
]

PlanCosts = Literal["nominal", "measured"]
PLAN_COSTS: Final[tuple[PlanCosts, ...]] = ("nominal", "measured")
"""Costs that plans can be chosen by."""

_LOG = logging.getLogger("ertis_numba")
_RUNS = 5  # The shortest run counts.
_FLOOR_S = 2e-4  # Shorter runs are repeated.
_MICS, _RANGES = 32, 960
_MAX_S = 1.0  # Limit on the cost of a unit of work; a larger value is an error.
_BEYOND = 0.2  # Samples of a tile beyond its ranges, relative to the tile.
_PHASES = {"few": 1, "many": 12, "most": 64}  # The cost of a term is interpolated over the logarithm of their number.
_FEW_PAIRS, _MANY_PAIRS = 2, 10
_STREAM = 1.5  # Time of computing and rounding a sample of a stream, relative to rounding a sample.
_PAIR = 2.0  # Time of a pair of beam-grid points of several streams, which exceed the L2 cache, relative to one grid.
_COMBINE = 1.0  # Time of adding a stream to an amplitude, relative to the magnitude of a beam.
_UNKNOWN: Final = "cpu NEON"  # costs of instruction sets without nominal costs; the sums of both have the same form
_FRONT_UNITS: Final = ("call", "demodulate_16", "demodulate_32", "forward", "fold", "inverse")
_SUM_UNITS: Final = ("quantise", *(f"sum_{number}_{phases}" for number in ("float32", "int16") for phases in _PHASES))
_PAIR_UNITS: Final = ("pair_float32", "pair_int16", "image")
_SHIFT_UNITS: Final = ("shift", "level")
UNITS: Final = (*_FRONT_UNITS, *_SUM_UNITS, *_PAIR_UNITS, *_SHIFT_UNITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """Amount of work of a plan for one image.

    ``n_words`` are those of a sample, ``tap_bits`` those of a filter tap; ``n_outputs`` are the samples of each phase.
    ``n_computed`` counts the ranges of all tiles, some of which are unused. ``n_beams`` are summed from ``n_terms``
    each; ``n_pairs`` of grid points per direction are 0 without a beam grid. ``n_shifted`` beams are summed as spectra,
    one for each direction and focal zone. ``n_rows`` beams of rows take ``n_row_terms`` products in all. Signals pass
    ``n_filters`` matched filters. ``term_cost`` is the time of a term relative to that of delay-and-sum.
    """

    n_mics: int
    n_words: int
    n_samples: int
    n_taps: int
    tap_bits: int
    n_fft: int
    n_bins: int
    n_phases: int
    n_outputs: int
    n_directions: int
    n_ranges: int
    n_computed: int
    n_beams: int
    n_terms: int
    n_pairs: int
    precision: str
    n_shifted: int = 0
    n_streams: int = 0
    n_filters: int = 1
    n_rows: int = 0
    n_row_terms: int = 0
    term_cost: float = 1.0


@dataclass(frozen=True, slots=True)
class Costs:
    """Seconds per unit of work of each kernel, by the names in `UNITS`; `stages_ms` defines the units."""

    seconds: dict[str, float]

    def stages_ms(self, work: Work) -> dict[str, float]:
        """Return the predicted time of each stage in milliseconds."""
        unit = self.seconds
        rows = work.n_mics * work.n_phases
        # The samples of a tile fit into the first cache level with few phases, and not even into the second with many.
        # More phases never count as cheaper, even if they were measured to be.
        terms = np.maximum.accumulate([unit[f"sum_{work.precision}_{name}"] for name in _PHASES])
        signals = (work.n_rows or work.n_mics) * work.n_phases
        octaves, known = math.log2(signals / _MICS), np.log2(list(_PHASES.values()))
        # Beyond the largest measured number, as with a thousand microphones, the cost continues to rise.
        rise = (terms[-1] - terms[-2]) / (known[-1] - known[-2])
        term = float(np.interp(octaves, known, terms) + rise * max(0.0, octaves - known[-1]))
        points = work.n_directions * work.n_ranges
        quantised = signals * (1 + _BEYOND) * work.n_computed if work.precision == "int16" else 0.0
        seconds = {
            "demodulate": unit[f"demodulate_{work.tap_bits}"] * work.n_samples * work.n_taps * work.n_words,
            "matched filter": unit["forward"] * work.n_mics * _transform(work.n_fft)
            + unit["fold"] * rows * work.n_bins * (2 if work.n_shifted else work.n_filters)
            + unit["inverse"] * (work.n_shifted or rows * work.n_filters) * _transform(work.n_outputs),
            "16 bits": unit["quantise"] * quantised * (1 + _STREAM * work.n_streams),
            "rows": unit["sum_float32_many"] * work.n_row_terms,
            "sums": work.term_cost * term * work.n_beams * work.n_terms * work.n_computed
            + unit["shift"] * work.n_shifted * work.n_mics * work.n_bins,
            "interpolation": unit[f"pair_{work.precision}"]
            * work.n_directions
            * work.n_computed
            * work.n_pairs
            * (_PAIR if work.n_streams else 1.0),
            "image": unit["level" if work.n_shifted else "image"] * points * (1 + _COMBINE * work.n_streams),
            "calls": (8 if work.n_shifted else 6) * unit["call"],
        }
        return {name: 1000 * value for name, value in seconds.items()}


def _transform(n: int) -> float:
    return n * math.log2(max(n, 2))


def nominal_costs(kernels: KernelSet) -> Costs:
    """Return the published costs of a device, and of the CPU's instruction set."""
    # Their ratios count, not their values: `measured_costs` predicts times.
    name = f"{kernels.device} {kernels.instruction_set}".strip()
    return Costs(NOMINAL_COSTS.get(name, NOMINAL_COSTS[_UNKNOWN]))


def measured_costs(kernels: KernelSet, threads: int) -> Costs:
    """Return the costs of a device on this machine, measured once and stored in `cache_file`; nominal if simulated."""
    if kernels.simulated:
        return nominal_costs(kernels)
    key = (kernels.device, threads, kernels.hardware)
    with _ONE_AT_A_TIME:  # simultaneous measurements would disturb each other
        if key not in _KNOWN:
            path = cache_file(*key)
            _KNOWN[key] = _kept(path) or _measured(kernels, threads, path)
        return _KNOWN[key]


_ONE_AT_A_TIME = ForkSafeLock()
_KNOWN: dict[tuple[str, int, str], Costs] = {}


def cache_file(device: str, threads: int, hardware: str = "") -> Path:
    """Return the file of measured costs by machine, GPU (``hardware``) and library versions; delete it to remeasure."""
    machine = [platform.machine(), platform.processor(), platform.node()]
    machine += [os.environ.get(name, "") for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")]
    with suppress(OSError):
        machine.append(Path("/proc/cpuinfo").read_text("utf-8").partition("\n\n")[0].partition("model name")[2][:80])
    versions = [version(name) for name in ("ertis-numba", "numba", "numpy", "scipy")]
    if hardware:
        machine.append(hardware)
        for name in ("numba-cuda", "cupy-cuda12x", "cupy-cuda13x"):
            with suppress(PackageNotFoundError):
                versions.append(version(name))
    digest = hashlib.sha256("\n".join([*machine, *versions, *UNITS]).encode()).hexdigest()[:12]
    folder = os.environ.get("ERTIS_CACHE_DIR") or platformdirs.user_cache_dir("ertis-numba", appauthor=False)
    return Path(folder) / f"costs-{device}-{threads}-{digest}.json"


def _kept(path: Path) -> Costs | None:
    try:
        found = json.loads(path.read_text("utf-8"))
        seconds = {name: float(found[name]) for name in UNITS}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Costs(seconds) if all(0 < value <= _MAX_S for value in seconds.values()) else None


def _measured(kernels: KernelSet, threads: int, path: Path) -> Costs:
    _LOG.info("measuring the costs of the kernels of device %r; they are stored in %s", kernels.device, path)
    costs = measure(kernels, threads)
    part: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as file:
            part = Path(file.name)
            json.dump(costs.seconds, file, indent=1)
        return _first_of(costs, part, path)
    except OSError as error:
        _LOG.info("measured costs cannot be stored (%s); they are measured again by the next process", error)
        return costs
    finally:
        if part is not None:
            part.unlink(missing_ok=True)


def _first_of(costs: Costs, part: Path, path: Path) -> Costs:
    """Store costs, or return those that another process has stored meanwhile, so that both choose the same plan."""
    try:
        os.link(part, path)  # fails if the file exists
    except FileExistsError:
        kept = _kept(path)
        if kept is not None:
            return kept
        part.replace(path)
    except OSError:  # a file system without links
        part.replace(path)
    return costs


def measure(kernels: KernelSet, threads: int, units: Collection[str] = UNITS) -> Costs:
    """Measure some or all costs of a device and return them; it takes some tenths of a second."""
    random = np.random.default_rng(1)
    small = 8 if kernels.device == "numpy" else 1
    seconds: dict[str, float] = {}
    with _Bench(kernels, threads) as bench:
        for names, measured in (
            (_FRONT_UNITS, _front),
            (_SUM_UNITS, functools.partial(_sums, n_beams=256 // small)),
            (_PAIR_UNITS, functools.partial(_pairs, n_directions=1024 // small)),
            (_SHIFT_UNITS, functools.partial(_shifts, n_directions=256 // small)),
        ):
            if not set(names).isdisjoint(units):
                seconds.update(measured(bench, random))
    return Costs({name: seconds[name] for name in UNITS if name in units})


class _Bench:
    """Timer of kernels on arrays in the memory of the device."""

    def __init__(self, kernels: KernelSet, threads: int) -> None:
        self.kernels, self.threads = kernels, threads
        self.memory = kernels.memory()
        self._lane = self.memory.lane()

    def __enter__(self) -> Self:
        self._stack = ExitStack()
        self._stack.enter_context(self.kernels.threads(self.threads))
        self._stack.enter_context(self._lane.entered())
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        self.memory.close()

    def best(self, kernel: Callable[..., object], *arguments: object) -> float:
        """Return the shortest time of several runs in seconds."""
        here = [self.memory.table(each) if isinstance(each, np.ndarray) else each for each in arguments]

        def run(count: int) -> float:
            start_s = time.perf_counter()
            for _ in range(count):
                kernel(*here)
            self._lane.wait()
            return (time.perf_counter() - start_s) / count

        run(1)
        count = max(1, math.ceil(_FLOOR_S / max(run(1), 1e-7)))
        return min(run(count) for _ in range(_RUNS))

    def transforms(self, signals: NDArray[np.float32], analytic: NDArray[np.complex64]) -> fft.Transforms:
        """Return the transforms of two arrays."""
        memory = self.memory
        here, there = memory.table(signals), memory.table(analytic)
        return fft.plan(self.kernels.transforms, here, there, zeros=memory.zeros, stream=self._lane.stream)


def _front(bench: _Bench, random: np.random.Generator) -> dict[str, float]:
    """Return the costs of demodulation and matched filter."""
    n_samples, n_taps, factor, n_fft, n_phases, n_out, n_bins = 4000, 101, 20, 6000, 4, 1200, 1000
    kernels = bench.kernels
    words = random.integers(0, 2**32, (n_samples * factor + n_taps, 1), dtype=np.uint32)
    channels = np.arange(_MICS, dtype=np.int32)
    # Noise, because untouched zeros are a single page of memory, which is always in the nearest cache.
    signals = random.standard_normal((_MICS, n_fft), dtype=np.float32)
    tiny = np.zeros((2, 4), dtype=np.complex64)
    found = {"call": bench.best(kernels.envelope, tiny, 1, np.zeros((2, 4), dtype=np.float32))}
    taps = np.arange(n_taps).astype(np.int16)
    took_s = bench.best(
        kernels.demodulate_words, words, channels, taps, np.float32(1), factor, 3, n_samples - 8, signals
    )
    found["demodulate_16"] = took_s / (n_samples * n_taps)
    # Compiling another kernel would take seconds; a separate measurement gave a ratio of 1.6.
    found["demodulate_32"] = 1.6 * found["demodulate_16"]
    out = _complex_noise(random, (_MICS, n_phases, n_out))
    transforms = bench.transforms(signals, out)
    forward = functools.partial(transforms.forward, threads=bench.threads)
    found["forward"] = bench.best(forward) / _MICS / _transform(n_fft)
    responses = np.ones((_MICS, n_phases, n_bins), dtype=np.complex64)
    spectra = _complex_noise(random, (_MICS, n_fft // 2 + 1))
    found["fold"] = bench.best(kernels.multiply_and_fold, spectra, responses, 300, out) / (_MICS * n_phases * n_bins)
    inverse = functools.partial(
        transforms.inverse, threads=bench.threads
    )  # In place: the numbers grow and may overflow.
    found["inverse"] = bench.best(inverse) / (_MICS * n_phases) / _transform(n_out)
    return found


def _sums(bench: _Bench, random: np.random.Generator, n_beams: int) -> dict[str, float]:
    """Return the cost of a term at one range for each number of phases."""
    found: dict[str, float] = {}
    kernels = bench.kernels
    amplitude = np.empty((n_beams, _RANGES), dtype=np.float32)
    points = n_beams * _MICS * _RANGES
    for name, n_phases in _PHASES.items():
        signals = np.ones((_MICS, n_phases, _RANGES + 40), dtype=np.complex64)
        rows = np.arange(_MICS) * n_phases + random.integers(0, n_phases, (n_beams, _MICS))
        samples = random.integers(0, 16, (n_beams, _MICS))
        offsets = (rows * signals.shape[2] + samples).astype(np.int32)
        weights = np.full((n_beams, _MICS), 0.01 + 0.02j, dtype=np.complex64)
        took_s = bench.best(kernels.delay_and_sum_envelope, signals, offsets, weights, 0, _RANGES, amplitude)
        found[f"sum_float32_{name}"] = took_s / points
        tiles, scales, starts = _tiles(kernels, _MICS, n_phases)
        took_s = bench.best(kernels.quantise_tiles, signals, starts, np.float32(8000), tiles, scales)
        found["quantise"] = took_s / (tiles.size / 2)
        places = (rows * tiles.shape[3] + samples).astype(np.int32)
        whole = np.ones((n_beams, _MICS, 2, 2), dtype=np.int16)
        took_s = bench.best(
            kernels.delay_and_sum_envelope_int16,
            *(tiles, scales, starts, _RANGES, places, whole, np.float32(1), amplitude),
        )
        found[f"sum_int16_{name}"] = took_s / points
    return found


def _complex_noise(random: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    return random.standard_normal((*shape, 2), dtype=np.float32).view(np.complex64)[..., 0]


def _pairs(bench: _Bench, random: np.random.Generator, n_directions: int) -> dict[str, float]:
    """Return the cost of a pair of beam-grid points at one range, and of one point of the image."""
    n_nodes, points = 400, n_directions * _RANGES
    kernels = bench.kernels
    amplitude = np.empty((n_directions, _RANGES), dtype=np.float32)
    rows = np.arange(n_directions, dtype=np.int32)
    offsets = np.zeros((n_nodes, 1), dtype=np.int32)
    first = np.sort(random.integers(0, n_nodes - 80, n_directions)) // 4 * 4  # Some directions share all points.
    took_s: dict[str, list[float]] = {"float32": [], "int16": []}
    for n_pairs in (_FEW_PAIRS, _MANY_PAIRS):
        places = (first[:, None] + 8 * np.arange(n_pairs)).astype(np.int32)
        signals = random.standard_normal((1, 1, 2 * (_RANGES + 40)), dtype=np.float32).view(np.complex64)
        weights = np.ones((n_nodes, 1), dtype=np.complex64)
        taps = np.full((n_directions, n_pairs, 2), 0.1, dtype=np.float32)
        took_s["float32"].append(
            bench.best(
                kernels.interpolated_beams_envelope,
                *(signals, offsets, weights, places, taps, rows, 0, _RANGES, 1, amplitude),
            )
        )
        tiles, scales, starts = _tiles(kernels, 1, 1)
        whole = np.ones((n_nodes, 1, 2, 2), dtype=np.int16)
        integer_taps = np.full((n_directions, n_pairs, 2), 900, dtype=np.int16)
        took_s["int16"].append(
            bench.best(
                kernels.interpolated_beams_envelope_int16,
                *(tiles, scales, starts, _RANGES, offsets, whole, places, integer_taps, rows, np.float32(1), 1),
                amplitude,
            )
        )
    found: dict[str, float] = {}
    for precision, times_s in took_s.items():
        few_s, many_s = (time_s / points for time_s in times_s)
        pair = found[f"pair_{precision}"] = max((many_s - few_s) / (_MANY_PAIRS - _FEW_PAIRS), 1e-3 * many_s)
        image = max(few_s - _FEW_PAIRS * pair, 1e-3 * few_s)
        found["image"] = min(image, found.get("image", math.inf))
    return found


def _shifts(bench: _Bench, random: np.random.Generator, n_directions: int) -> dict[str, float]:
    """Return the cost of a microphone's bin in a sum of spectra, and of one point of the image from beams."""
    n_bins, n_out = 960, 1200
    kernels = bench.kernels
    spectra, beams = _complex_noise(random, (_MICS, 1, n_out)), _complex_noise(random, (n_directions, 1, n_out))
    starts, steps = random.integers(0, 2**32, (2, n_directions, _MICS), dtype=np.uint32)
    level_s = bench.best(kernels.envelope_rows, beams, 10, 0, _RANGES, np.empty((n_directions, _RANGES), np.float32))
    shift_s = bench.best(kernels.sum_spectra, spectra, starts, steps, 300, n_bins, beams)
    return {"shift": shift_s / (n_directions * _MICS * n_bins), "level": level_s / (n_directions * _RANGES)}


def _tiles(
    kernels: KernelSet, n_mics: int, n_phases: int
) -> tuple[NDArray[np.int16], NDArray[np.float32], NDArray[np.int32]]:
    """Return tiles of ones, their scales and their first ranges."""
    starts = np.arange(0, _RANGES, kernels.tile_ranges, dtype=np.int32)
    tiles = np.ones((len(starts), n_mics, n_phases, kernels.tile_ranges + 20, 2), dtype=np.int16)
    return tiles, np.ones(len(starts), dtype=np.float32), starts
