"""Script that converts an image to xarray, or ends with an error in one line if xarray is not installed."""

import sys

import numpy as np

import ertis_numba as ertis

image = ertis.Energyscape(np.ones((1, 2), np.float32), np.zeros(1), np.zeros(1), np.arange(1.0, 3.0), ertis.Settings())
try:
    image.to_xarray()
except ertis.ArgumentError as error:
    sys.exit(str(error))
