"""Modules in the place of the closed companions of RTIS Dev, so that its scripts run unchanged.

The package ``rtisdev`` (2.16) imports ``rtisserial`` and ``rtiscuda``, which are not on PyPI. Import this module first,
also in spawned children. docs/how-to/rtisdev-scripts.md lists the variables of the environment that it reads.
"""

import sys

from ertis_numba.interop.rtisdev import rtiscuda, rtisserial

__all__ = ["rtiscuda", "rtisserial"]

sys.modules.setdefault("rtisserial", rtisserial)
sys.modules.setdefault("rtiscuda", rtiscuda)
