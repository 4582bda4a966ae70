"""Waves from the directions of a map, and the operations on them that a compute device performs."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels import KernelSet

__all__ = ["Waves"]

Matrices = NDArray[np.complex64]
Powers = NDArray[np.float32]

_TURN: Final = 2.0**32


class Waves:
    """Waves from each direction, with delays (direction, mic), at frequencies in multiples of the bin spacing."""

    def __init__(
        self,
        delay_s: NDArray[np.float64],
        numbers: NDArray[np.uint32],
        spacing_hz: float,
        kernels: KernelSet,
        *,
        threads: int,
    ) -> None:
        self.threads = threads
        self._kernels, self._numbers = kernels, numbers
        turns = np.rint(delay_s.T * spacing_hz * _TURN).astype(np.int64).astype(np.uint32)
        self._turns = np.ascontiguousarray(turns)
        self._memory = kernels.memory()
        self._lane = self._memory.lane()
        self._steps = self._memory.table(self._turns)
        self._bins = self._memory.table(numbers)
        self._powers = self._memory.zeros((len(numbers), turns.shape[1]), np.float32)

    def vectors(self, bins: NDArray[np.intp], directions: NDArray[np.intp]) -> NDArray[np.complex128]:
        """Return the waves of numbered bins and directions (…), of magnitude 1 at each microphone: (…, mic)."""
        turns = self._numbers[bins][..., None] * self._turns.T[directions]
        return np.asarray(np.exp(-2j * np.pi / _TURN * turns))

    def steer(self, matrices: Matrices, bins: NDArray[np.intp] | None = None) -> Powers:
        """Return the quadratic form ``v^H C v`` of matrices for the wave v of each direction: (n, direction)."""
        return self._powers_of(self._kernels.steer_power, matrices, bins)

    def steer_vectors(self, vectors: NDArray[np.complex64]) -> Powers:
        """Return the sum of ``|x^H v|²`` over the vectors x, (bin, n, mic), of each bin: (bin, direction)."""
        return self._powers_of(self._kernels.steer_vectors, vectors)

    def _powers_of(
        self, kernel: Callable[..., None], arrays: NDArray[np.complex64], bins: NDArray[np.intp] | None = None
    ) -> Powers:
        out = np.empty((len(arrays), self._turns.shape[1]), np.float32)
        powers = self._powers[: len(arrays)]
        with self._kernels.threads(self.threads), self._lane.entered():
            numbers = self._bins if bins is None else self._lane.send(self._numbers[bins])
            kernel(self._lane.send(np.ascontiguousarray(arrays)), self._steps, numbers, powers)
            self._lane.fetch(powers, out)
            self._lane.wait()
        return out

    def clean(self, matrices: Matrices, powers: Powers, *, hollow: bool) -> Powers:
        """Return the sources of CLEAN-SC: (bin, direction), from their delay-and-sum powers; hollow: no diagonal."""
        out: NDArray[Any] = np.empty_like(powers)
        with self._kernels.threads(self.threads), self._lane.entered():
            here = self._lane.send(np.ascontiguousarray(matrices)), self._steps, self._bins, self._lane.send(powers)
            self._lane.run(lambda: self._kernels.clean_sources(*here, hollow, self._powers))
            self._lane.fetch(self._powers, out)
            self._lane.wait()
        return out

    def close(self) -> None:
        """Free the memory of the device."""
        self._memory.close()
