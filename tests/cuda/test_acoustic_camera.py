"""Acoustic maps on the GPU or in the simulator, compared with those of the CPU."""

import numpy as np
import pytest

import ertis_numba as ertis
from tests.cases import noise
from tests.cuda.plans import TINY

CHANGES = {
    "recording.n_samples": 4096,
    "processing.range_m": (0.05, 0.1),
    "passive.bands_hz": [[30e3, 40e3]],
    "passive.resolution_hz": 3e3,
    "processing.directions": "2d:5",
    "processing.mode": "passive",
}


@pytest.mark.parametrize("method", ["delay_and_sum", "capon", "hr_clean_sc"])
def test_gpu_map_equals_cpu_map(method):
    settings = TINY.replace(**CHANGES, **{"passive.method": method})
    measurement = noise(settings)
    found = {}
    for device in ("cpu", "cuda"):
        with ertis.AcousticCamera(settings, device, check=False) as camera:
            found[device] = camera.process(measurement)
    assert found["cuda"].power == pytest.approx(
        found["cpu"].power, rel=1e-4, abs=1e-5 * float(np.max(found["cpu"].power))
    )
