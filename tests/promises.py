"""Promised times, as multiples of the time of importing the libraries, which is measured in the same run."""

import functools
import subprocess
import sys
import time

import numpy as np

IMPORTS = [sys.executable, "-c", "import numba, scipy.fft, h5py"]


def best_ratio(once, *, times, promised):
    """Time of the fastest run divided by the time of the imports; stop after the first run within the promise."""
    best = np.inf
    for _ in range(times):
        start = time.perf_counter()
        once()
        best = min(best, (time.perf_counter() - start) / imports_s())
        if best < promised:
            break
    return best


@functools.cache
def imports_s():
    """Shortest time of an interpreter that imports the libraries of all commands."""
    taken_s = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(IMPORTS, check=True)
        taken_s.append(time.perf_counter() - start)
    return min(taken_s)
