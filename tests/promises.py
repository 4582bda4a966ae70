"""Times that are promised, on machines as quick as those they were promised for, and on slower ones.

They were promised for one that imports what all commands need in some 0.4 s, which is an estimate: on that machine
nobody measured it. Where that takes longer, so may all else.
"""

import functools
import subprocess
import sys
import time

import numpy as np

IMPORTS = [sys.executable, "-c", "import numba, scipy.fft, h5py"]
IMPORTS_S = 0.4


def best_s(once, *, times, promised_s):
    """Seconds of the quickest of some runs, on a machine as quick as promised; none follows one that was."""
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
    """How many times longer than promised this machine takes for what it has to do anyway; 1 at least."""
    taken_s = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(IMPORTS, check=True)
        taken_s.append(time.perf_counter() - start)
    return max(1.0, min(taken_s) / IMPORTS_S)
