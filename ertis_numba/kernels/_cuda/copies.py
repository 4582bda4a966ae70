"""Copies between host and GPU that take the processor a few microseconds.

Copies of Numba create several views, which takes the processor tens of microseconds.
"""

from typing import Any

from numpy.typing import NDArray

__all__ = ["Copies"]


class Copies:
    """Copies of contiguous arrays on one stream, which must not be the default one."""

    def __init__(self, stream: Any) -> None:
        from cupy.cuda import Stream, runtime  # noqa: PLC0415 - the import takes half a second; the simulator has none

        self._stream = Stream.from_external(stream)  # This keeps the stream alive.
        self._copy = runtime.memcpyAsync
        self._up, self._down = runtime.memcpyHostToDevice, runtime.memcpyDeviceToHost

    def to_device(self, array: NDArray[Any], there: Any) -> None:
        """Start to copy an array of the host to an array of the device of the same shape and type."""
        self._copy(_address(there), array.ctypes.data, array.nbytes, self._up, self._stream.ptr)

    def to_host(self, array: Any, out: NDArray[Any]) -> None:
        """Start to copy an array of the device to an array of the host of the same shape and type."""
        self._copy(out.ctypes.data, _address(array), out.nbytes, self._down, self._stream.ptr)


def _address(array: Any) -> int:
    return int(array.device_ctypes_pointer.value or 0)  # The pointer of an empty array is None.
