"""How long each effect takes."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["CostStopwatch"]


class CostStopwatch:
    """Adds up milliseconds by name.

    Attributes
    ----------
    cost_ms : dict of str to float
    """

    def __init__(self) -> None:
        self.cost_ms: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the block towards a name."""
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.cost_ms[name] += 1000 * (time.perf_counter() - start_s)
