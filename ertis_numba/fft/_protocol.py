"""What the transforms of every device do."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Transforms"]


class Transforms(Protocol):
    """The two transforms of the signal chain, along the last axis, single precision."""

    def forward(self, signals: NDArray[np.float32], *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of real signals: (mic, n) to (mic, n // 2 + 1)."""
        ...

    def inverse(self, spectra: NDArray[np.complex64], *, threads: int) -> None:
        """Replace spectra by their signals, divided by their length."""
        ...
