"""Protocol of the Fourier transforms of all devices."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Transforms"]


class Transforms(Protocol):
    """Transforms of two fixed arrays along the last axis, in single precision, not normalised in either direction."""

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        ...

    def inverse(self, *, threads: int) -> None:
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        ...
