"""Measurement of the computation time of each effect."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["CostStopwatch"]


class CostStopwatch:
    """Accumulates computation time in milliseconds by name."""

    def __init__(self) -> None:
        self.cost_ms: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the time of the enclosed block to a name."""
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.cost_ms[name] += 1000 * (time.perf_counter() - start_s)
