"""Array types of the kernels' arguments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Complex", "ComplexOrDouble", "Index", "Pcm", "Real", "Short", "Taps", "Turns", "Words"]

Words = NDArray[np.unsignedinteger[Any]]
Pcm = NDArray[np.int16] | NDArray[np.float32]
Real = NDArray[np.float32]
Complex = NDArray[np.complex64]
ComplexOrDouble = NDArray[np.complex64] | NDArray[np.complex128]
Index = NDArray[np.int32]
Short = NDArray[np.int16]
Taps = NDArray[np.int16] | NDArray[np.int32]
Turns = NDArray[np.uint32]
