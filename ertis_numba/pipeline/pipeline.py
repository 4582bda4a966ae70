"""Signal chain from measurements to energyscapes."""

import functools
import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba import kernels
from ertis_numba.analysis.range_cleaning import clean_in_place
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DeviceError
from ertis_numba.chain import paper, paper_scipy, planner
from ertis_numba.chain.beam_chain import Chain
from ertis_numba.chain.costs import PLAN_COSTS, PlanCosts
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.kernel_chain import KernelChain
from ertis_numba.chain.memory import require_memory
from ertis_numba.chain.word_stream import WordStream, foreign_stream
from ertis_numba.frames import Beams, Energyscape, Measurement, MicrophoneSignals
from ertis_numba.geometry import Grid, levelled_grid, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline.accepted_words import AcceptedWords, rescaled
from ertis_numba.pipeline.image_checks import ImageChecks
from ertis_numba.settings import ERROR_PRESETS_DB, Settings

if TYPE_CHECKING:
    from ertis_numba.pipeline.prediction import Prediction

__all__ = ["Pipeline"]

_GPU_BATCH: Final = 16  # measurements; several times as many as a GPU has lanes
_MAX_BATCH_BYTES: Final = 2**30
_NO_ATTITUDE: Final = (
    "no attitude is passed; pass the attitude_xyzw of each measurement to Pipeline.process, or process a recording "
    "with poses by 'ertis process --level'"
)


class Pipeline:
    """Signal chain for measurements of one sensor.

    The constructor chooses the plan, computes tables, allocates buffers and compiles kernels. Several threads may use
    one pipeline at the same time; each process needs its own.

    Parameters
    ----------
    settings : Settings or str or Path
        Settings, or the path of a TOML file with them.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device. ``auto`` is ``cuda``, an NVIDIA GPU, if there is one and its libraries are installed, otherwise
        ``cpu``. ``numpy`` runs the same algorithm without compiled kernels, for comparison. For the paper's method,
        ``numpy`` has the recursive filters of the authors, and the other devices have filters of linear phase.
    threads : int, optional
        Threads of one call of `process`; all cores by default. Neither the plan nor the result depends on it.
    max_error_db : float or {"draft", "standard", "fine", "exact"}, optional
        Error budget of the images in dB; that of ``settings.accuracy`` by default.
    graphs : bool, optional
        Record the chain as a CUDA graph, which saves the time to launch its kernels; True by default on a GPU, except
        with ``processing.level_directions``.
    max_bytes : int, optional
        Limit on the predicted memory, checked before any is allocated. By default, only the tables of a plan are
        limited: to 2 GiB, or to the available memory if no plan within 2 GiB keeps the error budget.
    predict : bool
        Predict the error of the first image, and of each image that is 10 dB fainter than all predicted before. Issue
        an `ErrorBudgetWarning`, once, if images may exceed the budget. A prediction takes some 0.2 s and memory for
        another image. It is omitted if it would need more than 256 MB, and for the paper's method. Also compare echoes
        with the call and with the layout, once, and issue a `CallMismatchWarning` or `LayoutMismatchWarning` if they
        do not match, and the directions with the array, and issue a `CoarseGridWarning` if a reflector between them may
        lose half of its power.
    plan : {"nominal", "measured"}
        Costs of kernels by which the planner chooses the fastest plan. ``nominal`` costs are published with this
        package: the same settings give the same plan, hence the same bits, on all machines with the same instruction
        set. ``measured`` costs are those of this machine, measured when they are first needed; the plan is faster on
        unusual machines. ``settings`` of the pipeline and of its images hold the plan that was chosen.

    Attributes
    ----------
    settings : Settings
        Settings with the complete plan in ``accuracy``.
    device : str
        Compute device in use.
    grid : Grid
        Directions of the images.
    range_m : (range,) float64
        Ranges of the images in metres.

    Raises
    ------
    ArgumentError
        The settings have a layout, grid or range that cannot be used, no plan keeps the limits on error and memory, or
        the device is unknown or does not support graphs.
    DeviceError
        The device is not available, or has too little memory.

    Examples
    --------
    Close a pipeline to free its memory, or use it in a ``with`` statement. The command ``ertis example reflectors``
    simulates the recording:

    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording, ertis.Pipeline(recording.settings) as pipeline:
    ...     images = pipeline.process_batch(recording)
    >>> images[0].amplitude.shape == (len(pipeline.grid), len(pipeline.range_m))
    True
    """

    def __init__(
        self,
        settings: Settings | str | Path,
        device: str = "auto",
        threads: int | None = None,
        *,
        max_error_db: float | str | None = None,
        graphs: bool | None = None,
        max_bytes: int | None = None,
        predict: bool = True,
        plan: PlanCosts = "nominal",
    ) -> None:
        checks.choice("plan", plan, PLAN_COSTS)
        if graphs is not None and not isinstance(graphs, bool):
            raise ArgumentError(f"graphs is {graphs!r}; pass True, False or None")
        if isinstance(settings, str | Path):
            settings = Settings.load(settings)
        if not isinstance(settings, Settings):
            raise ArgumentError(
                f"settings is of type {type(settings).__name__}; pass Settings, such as those of a recording, or the "
                "path of a TOML file"
            )
        left_bytes = None if max_bytes is None else require_memory(settings, max_bytes)
        if isinstance(max_error_db, str):
            checks.choice("max_error_db", max_error_db, ERROR_PRESETS_DB)
            max_error_db = ERROR_PRESETS_DB[max_error_db]
        kernel_set = kernels.load(device)
        threads = kernel_set.max_threads if threads is None else threads
        with kernel_set.threads(threads):  # refuses an impossible number
            pass
        if max_error_db is not None and settings.processing.method == "paper":
            raise ArgumentError(
                f"max_error_db is {max_error_db:g}, but processing.method 'paper' has no error budget; leave it out or "
                "use method 'fast'"
            )
        if max_error_db is not None:
            settings = settings.replace(accuracy=settings.accuracy.replace(max_error_db=float(max_error_db)))
        settings = planner.complete(settings, kernel_set, threads=threads, max_bytes=left_bytes, plan=plan)
        self.settings = settings
        self._uncleaned_settings = _without_cleaning(settings)
        self.device = kernel_set.device
        self._accepted_words = AcceptedWords(settings)
        self._closed = False
        self._threads = threads
        self._image_checks = ImageChecks(settings, kernel_set, threads=threads) if predict else None
        self._chain = self._build_chain(kernel_set, threads, graphs=graphs)
        self.grid: Grid = self._chain.grid
        self.range_m: NDArray[np.float64] = self._chain.range_m

    def process(
        self,
        measurement: Measurement,
        out: NDArray[np.float32] | None = None,
        *,
        threads: int | None = None,
        stream: WordStream | None = None,
        attitude_xyzw: ArrayLike | None = None,
        clean: bool = True,
    ) -> Energyscape:
        """Return the energyscape of one measurement.

        Parameters
        ----------
        measurement : Measurement
        out : (direction, range) float32, optional
            Array for the amplitudes; a new one by default.
        threads : int, optional
            Number of threads; that of the pipeline by default.
        stream : WordStream, optional
            Stream to which the words of the measurement were added as they arrived; see `stream`. The image has the
            same bits as without it.
        attitude_xyzw : (4,) array_like of float, optional
            Unit quaternion that rotates the sensor frame into the world frame; required if
            ``processing.level_directions`` is true. The directions of the image then refer to the horizontal plane; see
            `levelled_grid`. Directions that lie behind a sensor in this attitude, but in front of a level one, have the
            amplitude 0. The tables of directions are computed for each measurement.
        clean : bool, default True
            False to omit the cleaning that ``settings.processing`` may request. The settings of the image then request
            none.

        Raises
        ------
        DataError
            The measurement's array, call, record or air, or its data, are not those of the pipeline's settings.
        ArgumentError
            ``out`` has another shape or type, the device has fewer threads, the stream belongs to another pipeline, or
            ``attitude_xyzw`` is invalid, missing or not needed.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> bool(image.level_dbfs.max() < 0)
        True
        """
        checks.instance("measurement", measurement, Measurement, "a recording contains")
        self.settings.processing.require_image()
        if attitude_xyzw is not None and not self.settings.processing.level_directions:
            raise ArgumentError(
                "attitude_xyzw is given, but processing.level_directions is false; leave attitude_xyzw out, or set "
                "level_directions"
            )
        words, exponent = self._words_of(measurement)
        grid = heard = None
        if attitude_xyzw is None:
            self.settings.processing.require_sensor_frame(_NO_ATTITUDE)
        else:
            grid, is_behind = levelled_grid(self.grid, attitude_xyzw)
            heard = _Heard(grid, ~is_behind)
        amplitude = self._chain.new_image() if out is None else self._checked_out(out)
        if stream is not None and isinstance(self._chain, KernelChain):
            self._chain.process_streamed(stream, words, amplitude, threads=threads, grid=grid)
        elif stream is None or stream.is_of(None):
            self._chain.process(words, amplitude, threads=threads, grid=grid)
        else:
            raise foreign_stream()
        if heard is not None:
            amplitude[~heard.is_ahead] = 0.0
        return self._checked_image(rescaled(amplitude, exponent), measurement, clean=clean, heard=heard)

    def stream(self) -> WordStream:
        """Return a stream that demodulates words while they arrive from a sensor; it has buffers of its own.

        When the last words arrive, only the rest of the chain is left. Pass the method `WordStream.add` to
        `SonarDriver.configure`, and the stream to `process`:

        Examples
        --------
        >>> with SonarDriver.open("/dev/ttyACM0") as sonar:  # doctest: +SKIP
        ...     stream = pipeline.stream()
        ...     sonar.configure(Setup.of(settings), on_words=stream.add)
        ...     block = sonar.measure()
        ...     image = pipeline.process(Measurement(block.data, settings), stream=stream)
        """
        self._require_open()
        if not isinstance(self._chain, KernelChain):
            return WordStream()
        return self._chain.stream(np.zeros(self._accepted_words.format.shape_2d, self._accepted_words.format.dtype))

    def process_batch(
        self, measurements: Iterable[Measurement], out: NDArray[np.float32] | None = None
    ) -> list[Energyscape]:
        """Return the energyscapes of several measurements, in their order, with the same bits as from `process`.

        A GPU overlaps transfers and computation of consecutive measurements. On a processor, each core processes a
        measurement of its own if there are enough of them. `process_many` needs less memory.

        Parameters
        ----------
        measurements : iterable of Measurement
            All are read before the first one is processed, and all images are kept in memory.
        out : (measurement, direction, range) float32, optional
            Array for the amplitudes, which may be longer than the batch; new ones by default. Fresh memory often takes
            longer than the images, so pass the same array for batches whose images are not kept.

        Raises
        ------
        DataError
            As for `process`; nothing is processed then.
        ArgumentError
            ``out`` has another shape or type, or fewer images than the batch.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     images = ertis.Pipeline(recording.settings).process_batch(recording)
        >>> images[0].stamp.sequence
        0
        """
        self._require_open()
        self.settings.processing.require_image()
        self.settings.processing.require_sensor_frame(_NO_ATTITUDE)
        batch = list(checks.items("measurements", measurements, Measurement, "a recording contains"))
        words = [self._words_of(measurement) for measurement in batch]
        amplitudes = [self._chain.new_image() for _ in batch] if out is None else self._checked_outs(out, len(batch))
        self._chain.process_batch([each for each, _ in words], amplitudes)
        return [
            self._checked_image(rescaled(amplitude, exponent), measurement, clean=True)
            for amplitude, (_, exponent), measurement in zip(amplitudes, words, batch, strict=True)
        ]

    def process_many(
        self, measurements: Iterable[Measurement], *, batch_size: int | None = None
    ) -> Iterator[Energyscape]:
        """Return an iterator over the energyscapes of any number of measurements, in their order.

        Memory is bounded: at most one batch of measurements is read ahead, and no image is kept. The bits are those of
        `process`.

        Parameters
        ----------
        measurements : iterable of Measurement
            Recording, list or generator. It is read one batch at a time, when the next image is asked for.
        batch_size : int, optional
            Measurements per batch. By default, one for each thread, or 16 on a GPU, and fewer if a batch would
            exceed 1 GiB. Use 1 for a live source, whose images should not wait for further measurements.

        Raises
        ------
        DataError
            As for `process`, when a batch is processed; the images of the batches before have been yielded.
        ArgumentError
            ``batch_size`` is below 1, the pipeline is closed, or an item is no measurement.

        Examples
        --------
        The command ``ertis example reflectors`` simulates the recording:

        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     pipeline = ertis.Pipeline(recording.settings)
        ...     loudest = [float(image.amplitude.max()) for image in pipeline.process_many(recording)]
        >>> len(loudest) == len(recording)
        True
        """
        self._require_open()
        self.settings.processing.require_image()
        self.settings.processing.require_sensor_frame(_NO_ATTITUDE)
        size = self._batch_size() if batch_size is None else checks.integer("batch_size", batch_size, 1)
        return self._batches(checks.items("measurements", measurements, Measurement, "a recording contains"), size)

    def _batches(self, measurements: Iterator[Measurement], size: int) -> Iterator[Energyscape]:
        while batch := list(itertools.islice(measurements, size)):
            images = [self.process(batch[0])] if len(batch) == 1 else self.process_batch(batch)
            batch.clear()
            images.reverse()
            while images:  # None is kept: a GPU's images lie in pinned memory that the next ones need.
                yield images.pop()

    def _batch_size(self) -> int:
        each_bytes = 4 * len(self.grid) * len(self.range_m) + self._accepted_words.format.n_bytes
        count = _GPU_BATCH if self.device == "cuda" else self._threads
        return max(1, min(count, _MAX_BATCH_BYTES // each_bytes))

    def signals(self, measurement: Measurement) -> MicrophoneSignals:
        """Return the demodulated and the matched-filtered signals of a measurement, with their time axis.

        Use them to put another beamformer behind this front end.

        Parameters
        ----------
        measurement : Measurement

        Returns
        -------
        MicrophoneSignals
            Signals of the enabled microphones at ``settings.signal_rate_hz``.

        Raises
        ------
        DataError
            As for `process`.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     signals = ertis.Pipeline(recording.settings).signals(recording[0])
        >>> signals.demodulated.shape == signals.matched.shape == (len(signals.positions_m), len(signals.time_s))
        True
        """
        from ertis_numba.chain.signals import matched, signals_of  # noqa: PLC0415  few want them

        self._require_open()
        checks.instance("measurement", measurement, Measurement, "a recording contains")
        self._accepted_words.require_sensor(measurement.settings)
        layout, rate_hz = microphones(self.settings.array), self.settings.signal_rate_hz
        demodulated = signals_of(measurement, settings=self.settings)
        return MicrophoneSignals(
            demodulated=demodulated,
            matched=matched(demodulated, self.settings),
            time_s=np.arange(demodulated.shape[1]) / rate_hz,
            sample_rate_hz=rate_hz,
            positions_m=layout.enabled_positions_m,
            delay_s=layout.delay_s[layout.enabled],
            sound_speed_m_s=sound_speed_m_s(self.settings.air),
            settings=self.settings,
            stamp=measurement.stamp,
        )

    def beams(self, measurement: Measurement) -> Beams:
        """Return the beams of a measurement: the sums of the delayed microphone signals, before their envelope.

        Delays are exact, as with ``accuracy.delay_taps = 0``. The processor computes beams, for any device.

        Parameters
        ----------
        measurement : Measurement

        Raises
        ------
        DataError
            As for `process`.
        ArgumentError
            The method is ``paper``, or the beamformer is not ``delay_and_sum``.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     beams = ertis.Pipeline(recording.settings).beams(recording[0])
        >>> str(beams.beam.dtype)
        'complex64'
        """
        self.settings.processing.require_beams("beams are needed")
        self.settings.processing.require_sensor_frame("beams are computed in the frame of the sensor")
        checks.instance("measurement", measurement, Measurement, "a recording contains")
        words, exponent = self._words_of(measurement)
        settings, chain = self._beam_chain
        beam: NDArray[Any] = chain.new_image()
        chain.process(words, beam)
        rescaled(beam.view(np.float32), exponent)
        return Beams(beam, self.grid.azimuth_rad, self.grid.elevation_rad, self.range_m, settings, measurement.stamp)

    @functools.cached_property
    def _beam_chain(self) -> tuple[Settings, Chain]:
        from ertis_numba.chain.beam_chain import BeamChain, beam_settings  # noqa: PLC0415  few want them

        host = kernels.load("numpy") if self.device == "numpy" else kernels.load_host()
        threads = min(self._threads, host.max_threads)
        settings = beam_settings(self._uncleaned_settings, host, threads=threads)
        return settings, BeamChain(settings, host, threads=threads)

    def result(self, measurement: Measurement) -> MicrophoneSignals | Beams | Energyscape:
        """Return the result of the last stage of processing, ``settings.processing.last_stage``.

        Parameters
        ----------
        measurement : Measurement

        Returns
        -------
        MicrophoneSignals, Beams or Energyscape
            That of `signals` for ``demodulation`` and ``matched_filter``, of `beams` for ``beams``, and of `process`
            for ``envelope``.

        Raises
        ------
        DataError
            As for `process`.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     settings = recording.settings.replace("processing.last_stage", "beams")
        ...     result = ertis.Pipeline(settings).result(recording[0])
        >>> type(result).__name__
        'Beams'
        """
        stage = self.settings.processing.last_stage
        if stage == "envelope":
            return self.process(measurement)
        return self.beams(measurement) if stage == "beams" else self.signals(measurement)

    @property
    def prediction(self) -> "Prediction | None":
        """Latest predicted error and its budget; None before the first image with sound."""
        return None if self._image_checks is None else self._image_checks.prediction

    def close(self) -> None:
        """Free the memory of the device once running calls have ended. Images stay valid."""
        if not self._closed:
            self._closed = True
            self._chain.close()
            self.__dict__.pop("_beam_chain", (None, self._chain))[1].close()

    def __enter__(self) -> Self:
        self._require_open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _build_chain(self, kernel_set: kernels.KernelSet, threads: int, *, graphs: bool | None) -> Chain:
        """Return the chain with compiled kernels and allocated buffers."""
        try:
            chain = _chain(self.settings, kernel_set, threads, graphs=graphs)
            if not kernel_set.simulated:
                chain.warm_up(np.zeros(self._accepted_words.format.shape_2d, self._accepted_words.format.dtype))
        except DeviceError as error:
            failed = str(error)
        else:
            return chain
        # Raised here, because a pending exception would keep the memory allocated, and a smaller pipeline would fail.
        raise DeviceError(failed)

    def _require_open(self) -> None:
        if self._closed:
            raise ArgumentError("the pipeline is closed; create another one")

    def _checked_image(
        self,
        amplitude: NDArray[np.float32],
        measurement: Measurement,
        *,
        clean: bool,
        heard: "_Heard | None" = None,
    ) -> Energyscape:
        """Return an image, cleaned after all checks, because predictions need all amplitudes."""
        image = Energyscape(
            amplitude=amplitude,
            azimuth_rad=self.grid.azimuth_rad,
            elevation_rad=self.grid.elevation_rad,
            range_m=self.range_m,
            settings=self._uncleaned_settings,
            stamp=measurement.stamp,
        )
        if self._image_checks is not None and (heard is None or heard.is_ahead.any()):
            self._image_checks.check(image if heard is None else heard.of(image), measurement)
        processing = self.settings.processing
        if not clean or not processing.is_cleaned:
            return image
        clean_in_place(amplitude, within_db=processing.clean_within_db, above_mean_db=processing.clean_above_mean_db)
        return image.replace(settings=self.settings)

    def _words_of(self, measurement: Measurement) -> tuple[NDArray[Any], int]:
        """Return the words, scaled into the range of single precision, and the exponent n of the divisor 2^n."""
        self._require_open()
        return self._accepted_words.read(measurement)

    def _checked_out(self, out: NDArray[np.float32]) -> NDArray[np.float32]:
        wanted = (len(self.grid), len(self.range_m))
        if out.dtype != np.float32 or out.shape != wanted or not out.flags.c_contiguous or not out.flags.writeable:
            raise ArgumentError(f"out is {out.dtype} of shape {out.shape}; use contiguous float32 of shape {wanted}")
        return out

    def _checked_outs(self, out: NDArray[np.float32], count: int) -> list[NDArray[np.float32]]:
        if np.ndim(out) != 3 or len(out) < count:
            raise ArgumentError(f"out has shape {np.shape(out)}; use {count} or more images, (image, direction, range)")
        return [self._checked_out(each) for each in out[:count]]


class _Heard(NamedTuple):
    """Directions of a level image in the sensor frame; those that are not ``is_ahead`` have the amplitude 0."""

    grid: Grid
    is_ahead: NDArray[np.bool_]

    def of(self, image: Energyscape) -> Energyscape:
        """Return the part of an image that is ahead, with its directions in the sensor frame."""
        return image.replace(
            amplitude=image.amplitude[self.is_ahead],
            azimuth_rad=self.grid.azimuth_rad[self.is_ahead],
            elevation_rad=self.grid.elevation_rad[self.is_ahead],
        )


def _without_cleaning(settings: Settings) -> Settings:
    """Return the same settings if they request no cleaning."""
    if not settings.processing.is_cleaned:
        return settings
    return settings.replace(**{"processing.clean_within_db": None, "processing.clean_above_mean_db": None})


def _chain(settings: Settings, kernel_set: kernels.KernelSet, threads: int, *, graphs: bool | None) -> Chain:
    if settings.processing.level_directions:
        if graphs:
            raise ArgumentError(
                "graphs is True, but with processing.level_directions each image needs other tables, which a CUDA "
                "graph cannot replace; leave graphs out"
            )
        graphs = False
    if settings.processing.method == "fast":
        return FastChain(settings, kernel_set, threads=threads, graphs=graphs)
    if kernel_set.device == "numpy":
        return paper_scipy.ScipyPaperChain(settings)
    return paper.PaperChain(settings, kernel_set, threads=threads, graphs=graphs)
