"""From measurements to energyscapes."""

import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks, kernels
from ertis_numba.errors import ArgumentError, CallMismatchWarning, DataError, DeviceError, ErrorBudgetWarning
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import Grid, microphones
from ertis_numba.sample_format import sample_format
from ertis_numba.settings import ERROR_PRESETS_DB, Array, Settings
from ertis_numba.stages import planner
from ertis_numba.stages.chain import Chain
from ertis_numba.stages.fast import FastChain
from ertis_numba.stages.memory import require_memory

if TYPE_CHECKING:
    from ertis_numba.prediction import BudgetMonitor, Prediction

__all__ = ["Pipeline"]

_CALL_CHECKS: Final = 8


class Pipeline:
    """The whole signal chain for one kind of measurement.

    Tables and buffers are made here, once. A pipeline may be used by several threads at a time; make one
    in each process.

    Parameters
    ----------
    settings : Settings or str or Path
        Settings, or the path of a TOML file with them.
    device : {"auto", "cpu", "cuda", "numpy"}
        ``auto`` is an NVIDIA GPU, ``cuda``, where there is one and what it needs is installed, else ``cpu``. ``numpy``
        runs the same algorithm without compiled kernels, for comparison. The paper's method has no compiled kernels.
    threads : int, optional
        Threads of one `process`; all cores by default. Neither the plan nor the result depends on it.
    max_error_db : float or {"draft", "standard", "fine", "exact"}, optional
        Error that the images may have; that of ``settings.accuracy`` by default.
    graphs : bool
        Whether a GPU records the chain as a CUDA graph, which saves the processor the launches.
    max_bytes : int, optional
        Limit on the predicted memory, checked before any is allocated. By default, only a plan's tables are limited, to
        2 GiB, or to the memory that the machine has available if no plan within 2 GiB keeps the error budget.
    predict : bool
        Predict the error of the first image, and of each image that is 10 dB fainter than all predicted before. Issue
        an `ErrorBudgetWarning`, once, if images may exceed the budget. A prediction takes some 0.2 s and memory for
        another image. Records whose prediction takes more than 256 MB have none, and nor has the paper's method.
        Compare echoes with the call, too, and issue a `CallMismatchWarning` if they do not match.

    Attributes
    ----------
    settings : Settings
        With the plan that was chosen: their accuracy leaves nothing open.
    device : str
        The device that was chosen.
    grid : Grid
        The direction axis of the images.
    range_m : (range,) float64
        The range axis of the images.

    Raises
    ------
    ArgumentError
        The settings name a layout, grid or range that cannot be used, no plan keeps the limits on error and memory, or
        the device is unknown or has no graphs.
    DeviceError
        The device cannot be used here, or has too little memory.

    Examples
    --------
    A pipeline holds a GPU's memory until it is closed::

        with Pipeline(recording.settings, device="cuda") as pipeline:
            images = pipeline.process_batch(recording)
    """

    def __init__(
        self,
        settings: Settings | str | Path,
        device: str = "auto",
        threads: int | None = None,
        *,
        max_error_db: float | str | None = None,
        graphs: bool = False,
        max_bytes: int | None = None,
        predict: bool = True,
    ) -> None:
        if isinstance(settings, str | Path):
            settings = Settings.load(settings)
        if not isinstance(settings, Settings):
            raise ArgumentError(
                f"settings is of type {type(settings).__name__}; give Settings, such as those of a recording, or the "
                "path of a TOML file"
            )
        left_bytes = None if max_bytes is None else require_memory(settings, max_bytes)
        if isinstance(max_error_db, str):
            checks.choice("max_error_db", max_error_db, ERROR_PRESETS_DB)
            max_error_db = ERROR_PRESETS_DB[max_error_db]
        kernel_set = kernels.load(_device_for(settings, device))
        threads = kernel_set.max_threads if threads is None else threads
        with kernel_set.threads(threads):  # refuses a number that cannot be had
            pass
        if max_error_db is not None and settings.processing.method == "paper":
            raise ArgumentError(
                f"max_error_db is {max_error_db:g}, and processing.method 'paper' has no plans; leave it out or give "
                "method 'fast'"
            )
        if max_error_db is not None:
            settings = settings.replace(accuracy=settings.accuracy.replace(max_error_db=float(max_error_db)))
        settings = planner.complete(settings, kernel_set, threads=threads, max_bytes=left_bytes)
        self.settings = settings
        self.device = kernel_set.device
        self._accepted_settings = settings
        self._format = sample_format(settings)
        self._closed = False
        self._monitor = (
            _budget_monitor(kernel_set, threads) if predict and settings.processing.method == "fast" else None
        )
        self._warned = False
        self._remaining_call_checks = _CALL_CHECKS if predict and not kernel_set.simulated else 0
        self._chain = self._build_chain(kernel_set, threads, graphs=graphs)
        self.grid: Grid = self._chain.grid
        self.range_m: NDArray[np.float64] = self._chain.range_m

    def process(
        self, measurement: Measurement, out: NDArray[np.float32] | None = None, *, threads: int | None = None
    ) -> Energyscape:
        """Return the energyscape of one measurement.

        Parameters
        ----------
        measurement : Measurement
        out : (direction, range) float32, optional
            Where the energy goes; a new array by default. Besides it, only the spectra are allocated anew.
        threads : int, optional
            Those of the pipeline by default, and at most those of its device.

        Raises
        ------
        DataError
            The measurement's array, call, record or air, or its words, are not those of the pipeline's
            settings.
        ArgumentError
            ``out`` has another shape or type, or there are fewer threads.
        """
        checks.instance("measurement", measurement, Measurement, "a recording holds")
        words, exponent = self._words_of(measurement)
        amplitude = self._chain.new_image() if out is None else self._checked_out(out)
        self._chain.process(words, amplitude, threads=threads)
        image = self._energyscape(_rescaled(amplitude, exponent), measurement)
        self._check_call(measurement)
        self._check_budget(image, measurement)
        return image

    def process_batch(self, measurements: Iterable[Measurement]) -> list[Energyscape]:
        """Return the energyscapes of several measurements, in their order, bit by bit as `process` gives them.

        A GPU takes one measurement in, works on another and gives back a third at the same time. The cores of a
        processor each take a measurement of their own, if there are as many; fewer go one after the other.

        Parameters
        ----------
        measurements : iterable of Measurement
            All are read before the first one is processed, and all images are held in memory.

        Raises
        ------
        DataError
            As for `process`; then nothing is processed.
        """
        self._require_open()
        batch = list(checks.items("measurements", measurements, Measurement, "a recording holds"))
        words = [self._words_of(measurement) for measurement in batch]
        amplitudes = [self._chain.new_image() for _ in batch]
        self._chain.process_batch([each for each, _ in words], amplitudes)
        images = [
            self._energyscape(_rescaled(amplitude, exponent), measurement)
            for amplitude, (_, exponent), measurement in zip(amplitudes, words, batch, strict=True)
        ]
        for image, measurement in zip(images, batch, strict=True):
            self._check_call(measurement)
            self._check_budget(image, measurement)
        return images

    def signals(self, measurement: Measurement, *, matched: bool = False) -> NDArray[Any]:
        """Return the signals of the enabled microphones before beamforming.

        Parameters
        ----------
        measurement : Measurement
        matched : bool
            Apply the call's matched filter.

        Returns
        -------
        (mic, sample) float32 or complex64
            Demodulated signals at ``settings.signal_rate_hz``, divided by the calibrated gains, full scale 1. Matched
            signals are analytic, and an echo has its peak where it begins.

        Raises
        ------
        DataError
            The measurement's array, call, record or air, or its words, are not those of the pipeline's settings.
        """
        from ertis_numba.stages.signals import matched_signals_of, signals_of  # noqa: PLC0415  few want them

        self._require_open()
        self._require_same_sensor(measurement.settings)
        return (matched_signals_of if matched else signals_of)(measurement, settings=self.settings)

    @property
    def prediction(self) -> "Prediction | None":
        """Latest predicted error beside its budget; None before the first image that is not silent."""
        return None if self._monitor is None else self._monitor.prediction

    def close(self) -> None:
        """Give back the memory of the device, when threads that are processing are done. Images that were made stay."""
        if not self._closed:
            self._closed = True
            self._chain.close()

    def __enter__(self) -> Self:
        self._require_open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_call(self, measurement: Measurement) -> None:
        """Compare echoes with the call until a measurement has sound above the noise, in the first few only."""
        if self._remaining_call_checks <= 0:
            return
        # Imported here because scipy.fft takes longer to import than the fast chain takes to start.
        from ertis_numba.analysis.call_match import call_match  # noqa: PLC0415

        self._remaining_call_checks -= 1
        match = call_match(replace(measurement, settings=self.settings))
        if match is not None:
            self._remaining_call_checks = 0
            if match.warning:
                warnings.warn(match.warning, CallMismatchWarning, stacklevel=3)

    def _check_budget(self, image: Energyscape, measurement: Measurement) -> None:
        """Predict the error of an image if it needs a prediction, and issue the warning once."""
        if self._monitor is None or self._warned:
            return
        try:
            prediction = self._monitor.check(image, measurement)
            text = prediction.warning if prediction else ""
        except DeviceError as error:
            text = f"the error of images is not predicted: {error}"
        if text:
            self._warned = True
            warnings.warn(text, ErrorBudgetWarning, stacklevel=3)

    def _build_chain(self, kernel_set: kernels.KernelSet, threads: int, *, graphs: bool) -> Chain:
        """Return the chain, its kernels compiled and its buffers made."""
        try:
            chain = _chain(self.settings, kernel_set, threads, graphs=graphs)
            if not kernel_set.simulated:
                chain.warm_up(np.zeros(self._format.shape_2d, self._format.dtype))
        except DeviceError as error:
            failed = str(error)
        else:
            return chain
        # Out here, as an error in flight would keep what did not fit, and a smaller pipeline would not fit either.
        raise DeviceError(failed)

    def _require_open(self) -> None:
        if self._closed:
            raise ArgumentError("the pipeline is closed; make another one")

    def _energyscape(self, amplitude: NDArray[np.float32], measurement: Measurement) -> Energyscape:
        return Energyscape(
            amplitude=amplitude,
            azimuth_rad=self.grid.azimuth_rad,
            elevation_rad=self.grid.elevation_rad,
            range_m=self.range_m,
            settings=self.settings,
            stamp=measurement.stamp,
        )

    def _words_of(self, measurement: Measurement) -> tuple[NDArray[Any], int]:
        """Return the words, scaled into the range of single precision, and the exponent of the divisor 2^n."""
        self._require_open()
        self._require_same_sensor(measurement.settings)
        return self._format.normalised(self._format.validated(measurement.data))

    def _require_same_sensor(self, settings: Settings) -> None:
        """Refuse what the tables were not made for: only how to process may differ."""
        if settings is self._accepted_settings:
            return
        for name in ("call", "recording", "air"):
            came, wanted = getattr(settings, name), getattr(self.settings, name)
            if came != wanted:
                raise DataError(f"measurement has {came}, the pipeline {wanted}; make a pipeline from its settings")
        if settings.array != self.settings.array and not _same_layout(settings.array, self.settings.array):
            raise DataError(
                f"measurement has array {settings.array.layout!r}, the pipeline another, "
                f"{self.settings.array.layout!r}; make a pipeline from its settings"
            )
        self._accepted_settings = settings

    def _checked_out(self, out: NDArray[np.float32]) -> NDArray[np.float32]:
        wanted = (len(self.grid), len(self.range_m))
        if out.dtype != np.float32 or out.shape != wanted or not out.flags.c_contiguous or not out.flags.writeable:
            raise ArgumentError(f"out is {out.dtype} of shape {out.shape}; give contiguous float32 of shape {wanted}")
        return out


def _budget_monitor(kernel_set: kernels.KernelSet, threads: int) -> "BudgetMonitor | None":
    """Return a monitor of the budget; simulated kernels would take minutes for a prediction."""
    if kernel_set.simulated:
        return None
    # Imported here because scipy.fft takes longer to import than the fast chain takes to start.
    from ertis_numba.prediction import BudgetMonitor  # noqa: PLC0415

    return BudgetMonitor(kernel_set, threads)


def _rescaled(amplitude: NDArray[np.float32], exponent: int) -> NDArray[np.float32]:
    """Return an image multiplied by a power of two, in place.

    Raises
    ------
    DataError
        The image would not fit single precision.
    """
    if exponent:
        with np.errstate(over="ignore"):
            np.ldexp(amplitude, exponent, out=amplitude)
        if not np.isfinite(amplitude).all():
            raise DataError(
                f"the measurement's samples reach 2^{exponent}, so its image exceeds the largest float32, 3.4e38; "
                "divide the samples by their full scale"
            )
    return amplitude


def _device_for(settings: Settings, device: str) -> str:
    """Return the device to load; the paper's method has NumPy only.

    Raises
    ------
    DeviceError
        Another one is asked for by name.
    """
    if settings.processing.method == "fast" or device not in {"auto", *kernels.DEVICES}:
        return device
    if device not in {"auto", "numpy"}:
        raise DeviceError(
            f"processing.method 'paper' has no kernels for device {device!r}; use device 'numpy' or 'auto'"
        )
    return "numpy"


def _same_layout(array: Array, other: Array) -> bool:
    """Whether two arrays are the same microphones, one named and one written out, say."""
    came, wanted = microphones(array), microphones(other)
    return came.word_bits == wanted.word_bits and all(
        np.array_equal(getattr(came, name), getattr(wanted, name))
        for name in ("positions_m", "enabled", "gain", "delay_s")
    )


def _chain(settings: Settings, kernel_set: kernels.KernelSet, threads: int, *, graphs: bool) -> Chain:
    if settings.processing.method == "fast":
        return FastChain(settings, kernel_set, threads=threads, graphs=graphs)
    # Imported here because scipy.signal takes longer to import than the fast chain takes to start.
    from ertis_numba.stages.paper import PaperChain  # noqa: PLC0415

    return PaperChain(settings)
