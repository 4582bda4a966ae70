"""Parts of the GPU benchmark, each in a separate process: ``python -m ertis_bench.gpu_trials.gpu_parts NAME FILE``.

A part yields rows. Each row is written to the file at once as a line of JSON, so that a later failure loses no results.
"""

import functools
import importlib.metadata
import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench import checks, input_measurements, timing
from ertis_bench.gpu_trials import rivals
from ertis_bench.gpu_trials.gpu import REFUSED
from ertis_bench.gpu_trials.gpu_stages import stages
from ertis_bench.paper import DIRECTIONS, FASTEST, PUBLISHED_MS, RANGE_M
from ertis_bench.passive.sound_signals import OWN_RMS, SOURCES, listening, noise
from ertis_bench.plans import in_words
from ertis_numba import kernels
from ertis_numba.base.errors import DataError, DeviceError
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.frames import Measurement
from ertis_numba.kernels.benchmarks import ceilings_of_cuda as ceilings
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Settings

__all__ = ["FULL", "PARTS", "Scale", "acoustic_maps", "ceilings_of", "machine", "paper", "side_by_side"]

_MAX_DIFFERENCE_DB = -100.0  # between devices that add the same terms in another order
_MAX_DIFFERENCE_16_BIT_DB = -80.0  # limit where intermediate numbers are rounded to 16 bits
_PUBLISHED_MS = dict(zip(map(str, DIRECTIONS), PUBLISHED_MS[FASTEST], strict=True))
_N_OPERATIONS, _N_BYTES = 8, 8  # per term and range: a complex multiply-add, and a complex64 to load
_N_IMAGES = 8  # pinned images that a stream fills in turn
_N_MAPS = 10  # Maps for each device and method.
_PACKAGES = ("numba-cuda", "cupy-cuda12x", "cupy-cuda13x", "cuda-bindings", "torch", "mach-beamform")
_SMI_FIELDS = (
    "driver_version",
    "memory.total",
    "clocks.max.sm",
    "clocks.max.memory",
    "clocks.sm",
    "clocks.memory",
    "power.limit",
    "pstate",
    "mig.mode.current",
)


@dataclass(frozen=True, slots=True)
class Scale:
    """Extent of the measurements.

    Attributes
    ----------
    subject : callable
        Returns the measurement and its description.
    directions : tuple of str
        Direction grids, as ``processing.directions``.
    range_m : tuple of float
    count : int
        Measurements that are processed one at a time.
    stream : int
        Measurements per stream.
    streams : int
        Number of streams.
    rivals : int
        Measurements per compared library.
    ceilings : tuple of (str, int)
        Names and values of further parameters of `ceilings.ceilings`.
    listening : tuple of (str, object)
        Names and values of settings of acoustic maps.
    methods : tuple of str
        Methods of acoustic maps.
    """

    subject: Callable[[], tuple[Measurement, str]] = input_measurements.measurement
    directions: tuple[str, ...] = ("90", "1850", "3000")
    range_m: tuple[float, float] = RANGE_M
    count: int = 200
    stream: int = 64
    streams: int = 7
    rivals: int = 30
    ceilings: tuple[tuple[str, int], ...] = ()
    listening: tuple[tuple[str, Any], ...] = (("processing__directions", "3000"),)
    methods: tuple[str, ...] = ("delay_and_sum", "capon", "music", "clean_sc")

    def settings(self, directions: str) -> tuple[Settings, Measurement]:
        """Return settings for a direction grid, and the measurement."""
        measurement, _ = self.subject()
        processing = measurement.settings.processing.replace(
            directions=directions, range_m=self.range_m, method="fast", wavefront="plane"
        )
        return measurement.settings.replace(processing=processing), measurement


FULL = Scale()


def machine(_: Scale) -> Iterator[dict[str, Any]]:
    """Yield the properties of the GPU."""
    kernel_set = kernels.load("cuda")
    if kernel_set.simulated:
        raise DeviceError("device 'cuda' is simulated here, so its times are meaningless; unset NUMBA_ENABLE_CUDASIM")
    import cupy  # noqa: PLC0415 - there with a GPU only

    properties = ceilings.properties()
    runtime = cupy.cuda.runtime
    yield {
        "name": kernel_set.hardware,
        "multiprocessors": properties["multiprocessors"],
        "compute_capability": properties["compute_capability"],
        "cuda_driver": _version(runtime.driverGetVersion()),
        "cuda_runtime": _version(runtime.runtimeGetVersion()),
        "packages": _installed(),
        **_smi(properties["uuid"]),
    }


def paper(scale: Scale) -> Iterator[dict[str, Any]]:
    """Yield one row per direction grid, with times of single measurements, stages and streams.

    Images are checked before they are timed.
    """
    for directions in scale.directions:
        settings, measurement = scale.settings(directions)
        words = _words(measurement)
        with Pipeline(settings, device="cuda", graphs=False) as plain, Pipeline(settings, device="cuda") as recorded:
            plan = plain.settings
            row: dict[str, Any] = {
                "directions": directions,
                "ranges": len(plain.range_m),
                "plan": in_words(plan.accuracy),
                **_checked(plain, recorded, measurement),
            }
            subjects = {
                name: functools.partial(pipeline.process, measurement, out=_pinned(pipeline, measurement))
                for name, pipeline in {"plain": plain, "graphs": recorded}.items()
            }
            times_ms = timing.round_robin(subjects, count=scale.count)
            row["one_at_a_time"] = {name: timing.summary(times) for name, times in times_ms.items()}
        row |= stages(plan, words, count=scale.count)
        row["streamed_ms"] = _streamed(plan, words, scale)
        if directions in _PUBLISHED_MS:
            best_ms = min(summary["median_ms"] for summary in row["one_at_a_time"].values())
            row["times_faster_than_published"] = round(_PUBLISHED_MS[directions][0] / best_ms, 1)
        yield row


def acoustic_maps(scale: Scale) -> Iterator[dict[str, Any]]:
    """Yield one row per method, with the times of maps on the GPU and on the processor, and their largest difference.

    The maps have third octaves, and the sound is float32 signals of three noise sources.
    """
    for method in scale.methods:
        settings = listening(**dict(scale.listening), passive__method=method)
        heard = noise(settings, SOURCES, own_rms=OWN_RMS, seed=1)
        with (
            AcousticCamera(settings, "cuda", check=False) as camera,
            AcousticCamera(settings, "cpu", check=False) as host,
        ):
            cameras = {"ours": camera, "cpu": host}
            times_ms = timing.round_robin(
                {name: functools.partial(each.process, heard) for name, each in cameras.items()}, count=_N_MAPS
            )
            found, wanted = (each.process(heard).power.astype(np.float64) for each in cameras.values())
        difference = float(np.max(np.abs(found - wanted)) / np.max(wanted))
        yield {
            "method": method,
            "directions": len(camera.grid),
            "bands": len(camera.band_hz),
            "bins": len(camera.frequency_hz),
            **{f"{name}_ms": timing.summary(times)["median_ms"] for name, times in times_ms.items()},
            "off_cpu_db": round(10 * float(np.log10(max(difference, 1e-30))), 1),
        }


def side_by_side(scale: Scale) -> Iterator[dict[str, Any]]:
    """Yield one row per direction grid and library, with its times and those of this package for the same sums.

    Both take turns, after their images have been compared. A failure is reported in its row, and the other rows follow.
    """
    for library, directions in itertools.product(rivals.LIBRARIES, scale.directions):
        row = {"library": library, "directions": directions}
        if not rivals.is_installed(library):
            yield row | {"status": "not installed"}
            continue
        settings, measurement = scale.settings(directions)
        try:
            yield row | rivals.race(library, settings, measurement, scale.rivals)
        except (ImportError, MemoryError, RuntimeError, TypeError, ValueError) as error:
            yield row | {"status": f"failed: {error}"}


def ceilings_of(scale: Scale) -> Iterator[dict[str, Any]]:
    """Yield the limits of the GPU, and the share of them that delay-and-sum without a beam grid reaches."""
    found = ceilings.ceilings(scale.count, **dict(scale.ceilings))
    rounded = {name: round(value, 1) for name, value in found.items()}
    yield {"ceilings": rounded, **_smi(ceilings.properties()["uuid"])}
    settings, measurement = scale.settings(scale.directions[-1])
    settings = settings.replace(accuracy=settings.accuracy.replace(precision="float32", beam_taps=0))
    with Pipeline(settings, device="cuda") as pipeline:
        plan, shape = pipeline.settings, (len(pipeline.grid), len(pipeline.range_m))
    tables = rivals.tables_of(plan, measurement)
    seconds = stages(plan, _words(measurement), count=scale.count)["stages_ms"]["delay-and-sum with envelope"] / 1e3
    points = tables.n_terms * shape[0] * shape[1]
    reached = {
        "float32_gop_s": points * _N_OPERATIONS / seconds / 1e9,
        "load_gb_s": points * _N_BYTES / seconds / 1e9,
    }
    shares = {name: rate / found[name] for name, rate in reached.items()}
    tighter = max(shares, key=lambda name: shares[name])
    yield {
        "directions": scale.directions[-1],
        "ranges": shape[1],
        "terms": tables.n_terms,
        "plan": in_words(plan.accuracy),
        "delay_and_sum_ms": round(1e3 * seconds, 4),
        **{name: round(rate, 1) for name, rate in reached.items()},
        "shares": {name: round(share, 3) for name, share in shares.items()},
        "tighter": tighter,
    }


PARTS: dict[str, Callable[[Scale], Iterator[dict[str, Any]]]] = {
    "machine": machine,
    "paper": paper,
    "acoustic maps": acoustic_maps,
    "side by side": side_by_side,
    "ceilings": ceilings_of,
}


def _checked(plain: Pipeline, recorded: Pipeline, measurement: Measurement) -> dict[str, float]:
    """Return the error relative to the exact image, and the difference from the CPU's image of the same plan."""
    image = plain.process(measurement)
    again = [
        recorded.process(measurement) for _ in range(3)
    ]  # The first call launches kernels, the second records a graph, and the third plays it.
    if any(not np.array_equal(other.amplitude, image.amplitude) for other in again):
        raise DataError("image of a CUDA graph differs from that of launched kernels; use graphs=False")
    error_db = checks.require_exact(image, measurement)
    same = Pipeline(plain.settings, device="cpu").process(measurement)
    difference_db = verification.error_db(image.amplitude, same.amplitude)
    wanted_db = _MAX_DIFFERENCE_DB if plain.settings.accuracy.precision == "float32" else _MAX_DIFFERENCE_16_BIT_DB
    if not difference_db <= wanted_db:
        raise DataError(
            f"image of {len(image.amplitude)} directions on 'cuda' differs from that on 'cpu' by {difference_db:.1f} "
            f"dB; the limit is {wanted_db:g} dB. Its time is not reported, because the result is wrong"
        )
    return {"error_db": round(error_db, 1), "off_cpu_db": round(difference_db, 1)}


def _pinned(pipeline: Pipeline, measurement: Measurement) -> NDArray[np.float32]:
    """Return the pinned array of an image as the pipeline creates it. Transfers to pinned memory are the fastest."""
    return pipeline.process(measurement).amplitude


def _streamed(plan: Settings, words: NDArray[Any], scale: Scale) -> dict[str, float]:
    """Return median times per measurement, for images copied to the host and for images that stay on the GPU."""
    found: dict[str, float] = {}
    for name, graphs in {"plain": False, "graphs": True}.items():
        chain = FastChain(plan, kernels.load("cuda"), threads=1, graphs=graphs)
        images = [chain.new_image() for _ in range(_N_IMAGES)]
        stream = [words] * scale.stream
        to_host = [images[number % _N_IMAGES] for number in range(scale.stream)]
        subjects = {
            f"to the host, {name}": functools.partial(chain.process_batch, stream, to_host),
            f"stay on the GPU, {name}": functools.partial(chain.process_batch, stream, [None] * scale.stream),
        }
        times_ms = timing.round_robin(subjects, count=scale.streams)
        found |= {key: round(float(np.median(times)) / scale.stream, 4) for key, times in times_ms.items()}
        chain.close()
    return found


def _words(measurement: Measurement) -> NDArray[Any]:
    n_samples = measurement.settings.recording.n_samples
    return np.require(measurement.data, requirements=["C", "A", "W"]).reshape(n_samples, -1)


def _installed() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _version(number: int) -> str:
    return f"{number // 1000}.{number % 1000 // 10}"


def _smi(uuid: str) -> dict[str, str]:
    """Return properties of the GPU from nvidia-smi, or an empty dict if the tool is missing."""
    command = ["nvidia-smi", *(["-i", uuid] if uuid else []), f"--query-gpu={','.join(_SMI_FIELDS)}"]
    try:
        done = subprocess.run(  # noqa: S603
            [*command, "--format=csv,noheader"], capture_output=True, text=True, check=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return {}
    values = [value.strip() for value in done.stdout.strip().splitlines()[0].split(",")]
    return dict(zip(_SMI_FIELDS, values, strict=True))


def _main(name: str, path: Path) -> None:
    with path.open("w", encoding="utf-8") as file:
        try:
            for row in PARTS[name](FULL):
                file.write(json.dumps(row) + "\n")
                file.flush()
        except DeviceError as error:
            sys.stderr.write(f"{error}\n")
            sys.exit(REFUSED)


if __name__ == "__main__":
    _main(sys.argv[1], Path(sys.argv[2]))
