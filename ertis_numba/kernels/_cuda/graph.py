"""CUDA graphs: the launches of a whole chain, recorded once and replayed by one call.

Numba does not support graphs. CuPy records all launches on a stream, both of Numba's kernels and of cuFFT.
"""

import contextlib
from collections.abc import Callable
from typing import Any

__all__ = ["Graph"]


class Graph:
    """Replayable graph of launches on the same arrays; ``stream`` is not the default one, which cannot be recorded."""

    def __init__(self, stream: Any) -> None:
        import cupy  # noqa: PLC0415 - the import takes half a second, and only graphs need it

        self._stream = cupy.cuda.Stream.from_external(stream)
        self._graph: Any = None

    def run(self, steps: Callable[[], None]) -> None:
        """Launch the steps: the first time one by one, which compiles kernels and allocates arrays, then as a graph."""
        if self._graph is not None:
            self._graph.launch(self._stream)
            return
        steps()
        with self._stream:
            self._stream.begin_capture()
            try:
                steps()
            except BaseException:
                with contextlib.suppress(Exception):  # a stream must not be left recording; the first error is raised
                    self._stream.end_capture()
                raise
            self._graph = self._stream.end_capture()
