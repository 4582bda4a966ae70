"""What the transforms of every device do."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Transforms"]


class Transforms(Protocol):
    """The two transforms of the signal chain, along the last axis, single precision, of arrays that stay the same.

    Both are sums without a factor in front: a signal that goes there and back is larger by the length.
    """

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n) to (mic, n // 2 + 1)."""
        ...

    def inverse(self, *, threads: int) -> None:
        """Replace the spectra in the array of analytic signals, (mic, phase, n), by their signals."""
        ...
