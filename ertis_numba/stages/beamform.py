"""From analytic signals to the envelopes of beams, by delay-and-sum."""

import math
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError, DeviceError
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Settings
from ertis_numba.stages.window import TimeWindow

__all__ = ["Beamform", "BeamformFloat32", "BeamformInt16", "Buffers", "DelayTable", "beamform"]

_DIRECTIONS_PER_PHASE = 30  # from here on 16 bits save more time than it takes to make them
_WEIGHT_BITS = 12  # leave the samples 13 bits with 32 microphones: both err by about -85 dB then

Buffers = tuple[NDArray[np.int16], NDArray[np.float32]]
"""What a call writes to on its way: tiles and their scales, empty where samples stay in float32."""


@dataclass(frozen=True, slots=True, eq=False)
class DelayTable:
    """Which sample of which phase each microphone adds to a direction's first range, and its weight.

    A delay is rounded to the nearest phase; the carrier's phase over the remainder goes into the weight, so
    that only the envelope is off by it.

    Attributes
    ----------
    phases, samples : (direction, mic) int64
    weights : (direction, mic) complex128
    """

    phases: NDArray[np.int64]
    samples: NDArray[np.int64]
    weights: NDArray[np.complex128]

    @classmethod
    def of(
        cls,
        delays_s: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        settings: Settings,
        window: TimeWindow,
        *,
        centre_hz: float,
    ) -> Self:
        """Return the table of ``delays_s``, (direction, mic), with the weight of each microphone."""
        n_phases = settings.processing.oversampling
        fine_rate_hz = settings.output_rate_hz * n_phases
        steps = np.rint(delays_s * fine_rate_hz)
        carrier = np.exp(2j * math.pi * centre_hz * (delays_s - steps / fine_rate_hz))
        samples, phases = np.divmod(steps.astype(np.int64), n_phases)
        return cls(phases, samples + window.lead, carrier * amplitudes)

    def offsets(self, n_phases: int, width: int) -> NDArray[np.int32]:
        """Return where the first sample lies in a flat array of (mic, phase, ``width``).

        Raises
        ------
        ArgumentError
            The array has too many samples to index.
        """
        n_mics = self.phases.shape[1]
        if n_mics * n_phases * width > np.iinfo(np.int32).max:
            raise ArgumentError(
                f"{n_mics} microphones, {n_phases} phases and {width} samples are too many to index; "
                "give a shorter range or less oversampling"
            )
        rows = np.arange(n_mics) * n_phases + self.phases
        return (rows * width + self.samples).astype(np.int32)


class Beamform(Protocol):
    """Analytic signals to the energy of every direction and range."""

    def new_buffers(self) -> Buffers:
        """Return what one call needs to write to."""
        ...

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,
        out: NDArray[np.float32],
    ) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        ...


def beamform(
    settings: Settings, window: TimeWindow, kernels: KernelSet, table: DelayTable
) -> "BeamformFloat32 | BeamformInt16":
    """Return the beamformer of ``settings.processing.precision``.

    Raises
    ------
    DeviceError
        The device has no 16-bit dot product.
    """
    precision = settings.processing.precision
    if precision == "auto":
        worth_it = len(table.weights) > _DIRECTIONS_PER_PHASE * settings.processing.oversampling
        precision = "int16" if worth_it and kernels.fastest_precision == "int16" else "float32"
    if precision == "float32":
        return BeamformFloat32(settings, window, kernels, table)
    if not kernels.tile_ranges:
        raise DeviceError(
            "processing.precision is 'int16', but this processor has no 16-bit dot product (AVX-512 VNNI or AVX-VNNI); "
            "give 'float32'"
        )
    return BeamformInt16(settings, window, kernels, table)


class BeamformFloat32:
    """See `Beamform`; samples stay in single precision."""

    def __init__(self, settings: Settings, window: TimeWindow, kernels: KernelSet, table: DelayTable) -> None:
        self._offsets = table.offsets(settings.processing.oversampling, window.n_outputs)
        self._weights = table.weights.astype(np.complex64)
        self._kernel = kernels.delay_and_sum_envelope

    def new_buffers(self) -> Buffers:
        """See `Beamform`."""
        return np.empty(0, dtype=np.int16), np.empty(0, dtype=np.float32)

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,  # noqa: ARG002
        out: NDArray[np.float32],
    ) -> None:
        """See `Beamform`."""
        self._kernel(analytic, self._offsets, self._weights, out)


class BeamformInt16:
    """See `Beamform`; samples go through 16 bits, scaled tile by tile of ranges.

    The 32-bit sums must hold all microphones at full scale: with weights up to ``w`` and parts of samples up
    to ``x``, that is ``√2 · n_mics · w · x ≤ 2³¹``. Weights get 12 bits of it, or half where there is less.
    """

    def __init__(self, settings: Settings, window: TimeWindow, kernels: KernelSet, table: DelayTable) -> None:
        n_mics = table.weights.shape[1]
        n_phases = settings.processing.oversampling
        n_ranges = len(window.range_m)
        bits = 31 - 0.5 - math.log2(n_mics)
        weight_bits = min(_WEIGHT_BITS, math.floor(bits / 2))
        # One off for rounding, and a sample has 15 bits at most.
        self._limit = np.float32(min(2.0 ** (bits - weight_bits), 2.0**15) - 1)
        largest = float(np.max(np.abs(table.weights)))
        scaled = table.weights * ((2**weight_bits - 1) / largest)
        pairs = [[scaled.real, -scaled.imag], [scaled.imag, scaled.real]]
        self._weights = np.ascontiguousarray(np.rint(np.moveaxis(np.array(pairs), (0, 1), (2, 3)))).astype(np.int16)
        self._weight_scale = np.float32(largest / (2**weight_bits - 1))
        width = kernels.tile_ranges + int(table.samples.max()) + 1
        self._offsets = table.offsets(n_phases, width)
        n_tiles = -(-n_ranges // kernels.tile_ranges)
        self._starts = np.arange(n_tiles, dtype=np.int32) * np.int32(kernels.tile_ranges)
        self._shape = (n_tiles, n_mics, n_phases, width, 2)
        self._quantise = kernels.quantise_tiles
        self._kernel = kernels.delay_and_sum_envelope_int16

    def new_buffers(self) -> Buffers:
        """See `Beamform`."""
        return np.zeros(self._shape, dtype=np.int16), np.zeros(self._shape[0], dtype=np.float32)

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,
        out: NDArray[np.float32],
    ) -> None:
        """See `Beamform`."""
        tiles, scales = buffers
        self._quantise(analytic, self._starts, self._limit, tiles, scales)
        self._kernel(tiles, scales, self._starts, self._offsets, self._weights, self._weight_scale, out)
