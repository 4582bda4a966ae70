"""Modules in the place of the closed companions of RTIS Dev, so that its scripts run unchanged.

The package ``rtisdev`` (2.16) imports ``rtisserial`` and ``rtiscuda``, which are not on PyPI. After
``import ertis_numba.interop.rtisdev``, both names mean the modules of this package, in this process and in children
that it forks. Spawned children do not inherit them, and need the import again. The environment selects the behaviour,
because scripts have no arguments for it:

=====================  ==================================================================================
ERTIS_RTISDEV_PORT     port to open instead of the one that the script names, such as an emulated sensor
ERTIS_RTISDEV_DEVICE   device for processing: auto, cpu, cuda or numpy; auto by default
ERTIS_RTISDEV_METHOD   exact, or fast for the chain of this package where it can do what the script says
=====================  ==================================================================================
"""

import sys

from ertis_numba.interop.rtisdev import rtiscuda, rtisserial

__all__ = ["rtiscuda", "rtisserial"]

sys.modules.setdefault("rtisserial", rtisserial)
sys.modules.setdefault("rtiscuda", rtiscuda)
