"""Butterworth low pass of order 6 at 100 kHz / 4.5 MHz: one polynomial or second-order sections in float32.

Six poles lie close to z = 1, and 24 bits of a polynomial's coefficients cannot separate them. Compared with 50 digits,
the polynomial moves a pole by 1.9e-3 and changes the impulse response by -23 dB. Sections move it by 2.4e-7 and change
the response by -119 dB. At 50 kHz, and in the band pass of 25 to 50 kHz, a pole of the polynomial leaves the unit
circle.
"""

import mpmath
import numpy as np
import pytest
import scipy.signal

from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline
from tests import reference
from tests.cases import SHORT, noise

ORDER, CUTOFF_HZ, RATE_HZ = 6, 100e3, 4.5e6
N_SAMPLES = 1500  # the slowest pole has decayed by 470 dB


def true_poles():
    """Poles of the low pass from Butterworth's circle and the bilinear transform, to 50 digits."""
    with mpmath.workdps(50):
        warped = mpmath.tan(mpmath.pi * mpmath.mpf(CUTOFF_HZ) / RATE_HZ)
        analogue = [warped * mpmath.expjpi(mpmath.mpf(2 * k + ORDER + 1) / (2 * ORDER)) for k in range(ORDER)]
        return [(1 + pole) / (1 - pole) for pole in analogue]


def true_impulse_response():
    """Impulse response from the recursion in 50 digits: (sample,) float64."""
    with mpmath.workdps(50):
        denominator = [mpmath.mpf(1)]
        for pole in true_poles():
            longer = [*denominator, mpmath.mpf(0)]
            denominator = [longer[k] - (pole * longer[k - 1] if k else 0) for k in range(len(longer))]
        denominator = [mpmath.re(value) for value in denominator]
        gain = mpmath.fsum(denominator) / 2**ORDER
        response = []
        for n in range(N_SAMPLES):
            value = gain * mpmath.binomial(ORDER, n) if n <= ORDER else mpmath.mpf(0)
            value -= sum(denominator[k] * response[n - k] for k in range(1, min(n, ORDER) + 1))
            response.append(value)
        return np.array([float(value) for value in response])


def roots(coefficients):
    """Exact roots of a polynomial whose coefficients are rounded to float32."""
    with mpmath.workdps(50):
        exact = [mpmath.mpf(float(value)) for value in np.asarray(coefficients, dtype=np.float32)]
        return mpmath.polyroots(exact[::-1], maxsteps=2000, extraprec=400, asc=True)


def largest_pole_error(found, wanted):
    """Largest distance of a wanted pole from the nearest one found."""
    return float(max(min(abs(pole - other) for other in found) for pole in wanted))


def test_polynomial_poles_move_10_000_times_as_far_as_section_poles():
    _, denominator = scipy.signal.butter(ORDER, CUTOFF_HZ, fs=RATE_HZ)
    sections = scipy.signal.butter(ORDER, CUTOFF_HZ, fs=RATE_HZ, output="sos")
    wanted = true_poles()
    assert float(max(map(abs, wanted))) == pytest.approx(0.964605, abs=1e-6)
    assert largest_pole_error(roots(denominator), wanted) > 1e-3  # 1.9e-3
    assert largest_pole_error([pole for section in sections for pole in roots(section[3:])], wanted) < 1e-6  # 2.4e-7


def test_sections_have_an_impulse_response_error_below_115_db():
    """Sections give -119 dB; the polynomial gives -23 dB in float32 and -196 dB in float64."""
    wanted = true_impulse_response()
    impulse = np.eye(1, N_SAMPLES)[0]
    polynomial = scipy.signal.butter(ORDER, CUTOFF_HZ, fs=RATE_HZ)
    sections = scipy.signal.butter(ORDER, CUTOFF_HZ, fs=RATE_HZ, output="sos")
    single = np.float32
    naive = scipy.signal.lfilter(*(part.astype(single) for part in polynomial), impulse.astype(single))
    assert reference.error_db(scipy.signal.sosfilt(sections.astype(single), impulse.astype(single)), wanted) < -115
    assert -30 < reference.error_db(naive, wanted) < -15
    assert reference.error_db(scipy.signal.lfilter(*polynomial, impulse), wanted) < -180


@pytest.mark.parametrize(
    ("band_hz", "kind", "rate_hz", "largest"),
    [
        (50e3, "lowpass", 4.5e6, 1.0204),
        ((25e3, 50e3), "bandpass", 450e3, 1.0296),
        ((25e3, 50e3), "bandpass", 4.5e6, 1.4),
    ],
)
def test_polynomial_form_is_unstable(band_hz, kind, rate_hz, largest):
    """Poles reach radius 1.02 at half the cutoff and 1.03 in the paper's band pass; those of sections stay below 1."""
    _, denominator = scipy.signal.butter(ORDER, band_hz, kind, fs=rate_hz)
    sections = scipy.signal.butter(ORDER, band_hz, kind, fs=rate_hz, output="sos")
    assert float(max(map(abs, roots(denominator)))) > largest - 1e-3
    assert all(abs(pole) < 1 for section in sections for pole in roots(section[3:]))


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")
def test_paper_image_needs_second_order_sections(monkeypatch):
    """Sections keep the image within -100 dB of the float64 image; the same filters as polynomials destroy it."""
    settings = SHORT.replace(processing=SHORT.processing.replace(method="paper"))
    pipeline, measurement = Pipeline(settings, "numpy"), noise(SHORT)
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    wanted, _ = reference.paper(measurement.data, settings, directions)
    assert reference.error_db(pipeline.process(measurement).amplitude, wanted) < -100

    def as_polynomial(sections, signals):
        return scipy.signal.lfilter(*(part.astype(signals.dtype) for part in scipy.signal.sos2tf(sections)), signals)

    monkeypatch.setattr(scipy.signal, "sosfilt", as_polynomial)
    assert not pipeline.process(measurement).amplitude.max() < 1e6  # 4e9 or NaN
