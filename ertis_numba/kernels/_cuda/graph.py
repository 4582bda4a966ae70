"""CUDA graphs: the launches of a whole chain, recorded once and played again by one call.

Numba has no graphs of its own; CuPy records whatever is launched on a stream, Numba's kernels and cuFFT's alike.
"""

import contextlib
from collections.abc import Callable
from typing import Any

__all__ = ["Graph"]


class Graph:
    """Steps that launch the same kernels on the same arrays each time.

    Parameters
    ----------
    stream : numba.cuda.Stream
        Not the default one, which cannot be recorded.
    """

    def __init__(self, stream: Any) -> None:
        import cupy  # noqa: PLC0415 - half a second that only those wait for who use graphs

        self._stream = cupy.cuda.Stream.from_external(stream)
        self._graph: Any = None

    def run(self, steps: Callable[[], None]) -> None:
        """Launch the steps: one by one the first time, which compiles kernels and makes arrays, then as a graph."""
        if self._graph is not None:
            self._graph.launch(self._stream)
            return
        steps()
        with self._stream:
            self._stream.begin_capture()
            try:
                steps()
            except BaseException:
                with contextlib.suppress(Exception):  # a stream must not be left recording; what failed is told
                    self._stream.end_capture()
                raise
            self._graph = self._stream.end_capture()
