"""Documented time limits, scaled for slower machines.

The limits apply to a machine that imports the libraries of all commands in 0.4 s. That time is an estimate, not a
measurement. A machine with slower imports may take proportionally longer.
"""

import functools
import subprocess
import sys
import time

import numpy as np

IMPORTS = [sys.executable, "-c", "import numba, scipy.fft, h5py"]
IMPORTS_S = 0.4


def best_s(once, *, times, promised_s):
    """Seconds of the fastest run, scaled to the assumed machine; stop after the first run within the limit."""
    best = np.inf
    for _ in range(times):
        start = time.perf_counter()
        once()
        best = min(best, (time.perf_counter() - start) / slowness())
        if best < promised_s:
            break
    return best


@functools.cache
def slowness():
    """Import time on this machine relative to the assumed one, at least 1."""
    taken_s = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(IMPORTS, check=True)
        taken_s.append(time.perf_counter() - start)
    return max(1.0, min(taken_s) / IMPORTS_S)
