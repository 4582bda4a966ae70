"""Protocol of the Fourier transforms of all devices."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Transforms"]


class Transforms(Protocol):
    """Transforms of the signal chain along the last axis, in single precision, for two fixed arrays.

    Neither transform is normalised: a forward and an inverse transform scale a signal by its length.
    """

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        ...

    def inverse(self, *, threads: int) -> None:
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        ...
