"""Promised processor times, as multiples of that of importing the libraries, which is measured in the same run.

Processor time is nearly independent of other programs, unlike the time by the clock.
"""

import subprocess
import sys
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

import numpy as np

IMPORTS = [sys.executable, "-c", "import numba, scipy.fft, h5py"]


def best_ratio(once, *, times, promised):
    """Processor time of the cheapest run relative to the imports; stop after the first run within the promise.

    The imports run right after each run, because other programs and the clock of a processor change both. One
    measurement suffices if even half of its time would keep the promise.
    """
    best = np.inf
    for _ in range(times):
        used_s = cpu_s(once)
        rough = used_s / imports_s(1)
        best = min(best, rough if rough < promised / 2 else used_s / imports_s(5))
        if best < promised:
            break
    return best


def cpu_s(once):
    """Processor time of a call, its threads and the processes that it waits for."""
    start_s = _used_s()
    once()
    return _used_s() - start_s


def imports_s(times):
    """Least processor time of some interpreters that import the libraries of all commands."""
    return min(cpu_s(lambda: subprocess.run(IMPORTS, check=True)) for _ in range(times))


def _used_s():
    used = [getrusage(who) for who in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)
