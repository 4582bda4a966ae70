"""Delay-and-sum with the array operations of other libraries, compared with this package's kernels.

The algorithm and its tables are this package's, without a beam grid. Only the implementation of the arithmetic differs.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_bench import timing
from ertis_bench.gpu_trials import rival_mach
from ertis_bench.plans import in_words
from ertis_numba import kernels
from ertis_numba.base.errors import DataError
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.frames import Measurement
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.settings import Settings

__all__ = ["LIBRARIES", "ArrayChain", "Library", "Tables", "is_installed", "numpy_library", "race", "tables_of"]

_GATHERED_BYTES = 2**28  # size of the samples that are gathered at a time
_MAX_DIFFERENCE_DB = -100.0
_BURST = 10


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """Arguments of the kernels of a chain, and the CPU's image from them.

    Attributes
    ----------
    channels : (mic,) int32
    taps : (tap,) int16 or int32
    scale : float
    factor, first, n_signals : int
        Arguments of `DemodulateWords`.
    n_fft : int
    responses : (mic, phase, b) or (1, phase, b) complex64
    first_bin : int
    n_outputs : int
    zones : list of tuple
        Offsets, weights, first and stop of each call of `DelayAndSumEnvelope`.
    image : (direction, range) float32
    """

    channels: NDArray[np.int32]
    taps: NDArray[Any]
    scale: float
    factor: int
    first: int
    n_signals: int
    n_fft: int
    responses: NDArray[np.complex64]
    first_bin: int
    n_outputs: int
    zones: list[tuple[NDArray[np.int32], NDArray[np.complex64], int, int]]
    image: NDArray[np.float32]

    @property
    def n_terms(self) -> int:
        """Number of samples that are summed per bin of the image."""
        return int(self.zones[0][0].shape[1])


def tables_of(settings: Settings, measurement: Measurement) -> Tables:
    """Return the tables that kernels receive for a complete plan in single precision without a beam grid."""
    kernel_set = kernels.load("cpu")
    seen: dict[str, list[tuple[Any, ...]]] = {}

    def spy(name: str) -> Callable[..., None]:
        kernel = getattr(kernel_set, name)

        def run(*arguments: Any) -> None:
            seen.setdefault(name, []).append(arguments)
            kernel(*arguments)

        return run

    names = ("demodulate_words", "multiply_and_fold", "delay_and_sum_envelope")
    changes: dict[str, Any] = {name: spy(name) for name in names}
    chain = FastChain(settings, dataclasses.replace(kernel_set, **changes), threads=1)
    image = chain.new_image()
    chain.process(measurement.data.reshape(settings.recording.n_samples, -1), image)
    ((_, channels, taps, scale, factor, first, n_signals, signals),) = seen["demodulate_words"]
    ((_, responses, first_bin, folded),) = seen["multiply_and_fold"]
    zones = [arguments[1:5] for arguments in seen["delay_and_sum_envelope"]]
    return Tables(
        channels=channels,
        taps=taps,
        scale=float(scale),
        factor=factor,
        first=first,
        n_signals=n_signals,
        n_fft=signals.shape[1],
        responses=responses,
        first_bin=first_bin,
        n_outputs=folded.shape[2],
        zones=zones,
        image=image,
    )


@dataclass(frozen=True, slots=True)
class Library:
    """Differences between libraries. Slices, indices, sums and products are the same in all of them."""

    upload: Callable[[NDArray[Any]], Any]
    download: Callable[[Any, NDArray[Any]], None]
    zeros: Callable[[tuple[int, ...], str], Any]
    arange: Callable[[int, int], Any]
    float32: Callable[[Any], Any]
    rfft: Callable[[Any], Any]
    ifft: Callable[[Any], Any]


def numpy_library() -> Library:
    """Return NumPy, with which the sums can be checked without a GPU."""
    return Library(
        upload=np.asarray,
        download=lambda array, out: np.copyto(out, array),
        zeros=np.zeros,
        arange=np.arange,
        float32=lambda array: array.astype(np.float32),
        rfft=scipy.fft.rfft,
        ifft=functools.partial(scipy.fft.ifft, norm="forward"),
    )


def cupy_library() -> Library:
    """Return CuPy."""
    import cupy  # noqa: PLC0415 - there with a GPU only

    return Library(
        upload=cupy.asarray,
        download=lambda array, out: cupy.asnumpy(array, out=out),
        zeros=cupy.zeros,
        arange=cupy.arange,
        float32=lambda array: array.astype(cupy.float32),
        rfft=cupy.fft.rfft,
        ifft=functools.partial(cupy.fft.ifft, norm="forward"),
    )


def torch_library(device: str = "cuda") -> Library:
    """Return PyTorch. Its 32-bit products are not rounded to TF32, which is also its default."""
    import torch  # noqa: PLC0415 - rarely there

    return Library(
        upload=lambda array: torch.from_numpy(array).to(device),
        download=lambda array, out: torch.from_numpy(out).copy_(array),
        zeros=lambda shape, dtype: torch.zeros(shape, dtype=getattr(torch, dtype), device=device),
        arange=functools.partial(torch.arange, device=device),
        float32=lambda array: array.to(torch.float32),
        rfft=torch.fft.rfft,
        ifft=functools.partial(torch.fft.ifft, norm="forward"),
    )


class ArrayChain:
    """Chain from words to image with array operations."""

    def __init__(self, tables: Tables, library: Library) -> None:
        self._tables, self._library = tables, library
        factor, n_taps = tables.factor, len(tables.taps)
        n_steps = -(-n_taps // factor)
        taps = np.zeros(n_steps * factor, np.float32)
        taps[:n_taps] = tables.taps * np.float64(tables.scale)
        self._taps = library.upload(np.ascontiguousarray(taps.reshape(n_steps, factor).T))
        self._begin = tables.first * factor - n_taps // 2
        self._n_inputs = (tables.n_signals + n_steps - 1) * factor
        self._octets = library.upload((tables.channels // 8).astype(np.int64))
        self._shifts = library.upload((tables.channels % 8).astype(np.uint8))
        self._responses = library.upload(tables.responses)
        self._zones = [
            (library.upload(offsets.astype(np.int64)), library.upload(weights), first, stop)
            for offsets, weights, first, stop in tables.zones
        ]

    def __call__(self, words: NDArray[Any], out: NDArray[np.float32]) -> None:
        """Process ``words``, (sample, word), and fill ``out``, (direction, range)."""
        octets = self._library.upload(words.view(np.uint8).reshape(len(words), -1))
        analytic = self._analytic(self._signals(octets))
        image = self._library.zeros(out.shape, "float32")
        for offsets, weights, first, stop in self._zones:
            ranges = self._library.arange(first, stop)
            at_a_time = max(1, _GATHERED_BYTES // (8 * offsets.shape[1] * (stop - first)))
            for begin in range(0, len(offsets), at_a_time):
                some = slice(begin, begin + at_a_time)
                heard = analytic[offsets[some, :, None] + ranges]
                image[some, first:stop] = abs((weights[some, None, :] @ heard)[:, 0])
        self._library.download(image, out)

    def _signals(self, octets: Any) -> Any:
        """Return signals, (mic, sample). Each step of the filter is a matrix product."""
        tables, library = self._tables, self._library
        begin, end = max(0, self._begin), min(len(octets), self._begin + self._n_inputs)
        bits = (octets[begin:end][:, self._octets] >> self._shifts) & 1
        padded = library.zeros((len(tables.channels), self._n_inputs), "float32")
        padded[:, begin - self._begin : end - self._begin] = (library.float32(bits) * 2 - 1).T
        steps = padded.reshape(len(tables.channels), -1, tables.factor) @ self._taps
        signals = library.zeros((len(tables.channels), tables.n_fft), "float32")
        for step in range(steps.shape[2]):
            signals[:, : tables.n_signals] += steps[:, step : step + tables.n_signals, step]
        return signals

    def _analytic(self, signals: Any) -> Any:
        """Return flattened analytic signals: (mic · phase · sample,)."""
        tables, library = self._tables, self._library
        n_bins, n_out = tables.responses.shape[2], tables.n_outputs
        spectra = library.rfft(signals)[:, None, tables.first_bin : tables.first_bin + n_bins] * self._responses
        folded = library.zeros((spectra.shape[0], spectra.shape[1], n_out), "complex64")
        begin = 0
        while begin < n_bins:
            k = (tables.first_bin + begin) % n_out
            n = min(n_out - k, n_bins - begin)
            folded[:, :, k : k + n] += spectra[:, :, begin : begin + n]
            begin += n
        return library.ifft(folded).reshape(-1)


LIBRARIES = {"CuPy": "cupy", "PyTorch": "torch", "mach": "mach"}
"""Libraries by name, with the imported module."""
_MAKERS = {"CuPy": cupy_library, "PyTorch": torch_library}


def is_installed(library: str) -> bool:
    """Return True if one of `LIBRARIES` can be imported."""
    return importlib.util.find_spec(LIBRARIES[library]) is not None


def race(library: str, settings: Settings, measurement: Measurement, count: int) -> dict[str, Any]:
    """Return times of a library and of this package for the same sums, from host to host.

    mach is compared for delay-and-sum only.
    """
    if library == "mach":
        return rival_mach.race(settings, measurement, count)
    direct = settings.accuracy.replace(precision="float32", beam_taps=0)
    with Pipeline(settings.replace(accuracy=direct), device="cuda") as pipeline:
        tables = tables_of(pipeline.settings, measurement)
        chain = ArrayChain(tables, _MAKERS[library]())
        image = pipeline.process(measurement).amplitude
        words, out = np.array(measurement.data).reshape(len(measurement.data), -1), np.empty_like(image)
        chain(words, out)
        difference_db = verification.error_db(out, image)
        if not difference_db <= _MAX_DIFFERENCE_DB:
            raise DataError(
                f"image of {library} differs from this package's by {difference_db:.1f} dB; "
                f"the limit is {_MAX_DIFFERENCE_DB:g} dB. The time is not reported, because the results differ"
            )
        subjects: dict[str, Callable[[], object]] = {
            "theirs": functools.partial(chain, words, image),  # The library also writes to pinned memory.
            "ours": functools.partial(pipeline.process, measurement, out=image),
        }
        times_ms = timing.round_robin(subjects, count=count, burst=_BURST)
    return {
        "what": "host to host",
        "plan": in_words(pipeline.settings.accuracy),
        "off_db": round(difference_db, 1),
        **_compared({name: timing.summary(times)["median_ms"] for name, times in times_ms.items()}),
    }


def _compared(times_ms: dict[str, float]) -> dict[str, float]:
    return {
        "theirs_ms": times_ms["theirs"],
        "ours_ms": times_ms["ours"],
        "times_faster": round(times_ms["theirs"] / times_ms["ours"], 2),
    }
