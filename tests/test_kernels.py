"""Every kernel of every device against its plain referee, over one table of cases."""

import inspect

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.kernels import _contract
from tests import cases, reference

KERNELS = {name: kernels.load(name) for name in kernels.DEVICES}
