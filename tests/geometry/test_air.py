"""Speed of sound and absorption compared with tabulated values."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose

from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.settings import Air

airs = st.builds(
    Air,
    temperature_c=st.floats(-40, 60),
    humidity_percent=st.floats(0, 100),
    pressure_pa=st.floats(10_000, 200_000),
)


@pytest.mark.parametrize(("temperature_c", "speed_m_s"), [(-20, 318.9), (0, 331.3), (20, 343.2), (40, 354.7)])
def test_speed_of_sound_in_dry_air_matches_tables(temperature_c, speed_m_s):
    assert sound_speed_m_s(Air(temperature_c=temperature_c, humidity_percent=0)) == pytest.approx(speed_m_s, abs=0.1)


def speed_by_cramer_m_s(temperature_c, humidity_percent, pressure_pa=101_325.0, carbon_dioxide=314e-6):
    """Return O. Cramer's fit to real gases at 0 to 30 °C, JASA 93 (1993), which is independent of our equations."""
    t, p, xc, kelvin = temperature_c, pressure_pa, carbon_dioxide, temperature_c + 273.15
    enhancement = 1.00062 + 3.14e-8 * p + 5.6e-7 * t**2
    saturation_pa = math.exp(1.2811805e-5 * kelvin**2 - 1.9509874e-2 * kelvin + 34.04926034 - 6.3536311e3 / kelvin)
    xw = humidity_percent / 100 * enhancement * saturation_pa / p
    return (
        331.5024
        + 0.603055 * t
        - 0.000528 * t**2
        + (51.471935 + 0.1495874 * t - 0.000782 * t**2) * xw
        + (-1.82e-7 + 3.73e-8 * t - 2.93e-10 * t**2) * p
        + (-85.20931 - 0.228525 * t + 5.91e-5 * t**2) * xc
        - 2.835149 * xw**2
        - 2.15e-13 * p**2
        + 29.179762 * xc**2
        + 0.000486 * xw * p * xc
    )


@pytest.mark.parametrize("temperature_c", [0, 10, 20, 30])
@pytest.mark.parametrize("humidity_percent", [0, 50, 100])
def test_speed_of_sound_in_humid_air_matches_tables(temperature_c, humidity_percent):
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    assert sound_speed_m_s(air) == pytest.approx(speed_by_cramer_m_s(temperature_c, humidity_percent), rel=5e-4)


def test_humidity_raises_speed_of_sound_by_at_most_0_45_percent():
    dry, humid = (sound_speed_m_s(Air(humidity_percent=percent)) for percent in (0, 100))
    assert 0.003 < humid / dry - 1 < 0.0045


def test_speed_of_sound_in_dry_air_ignores_pressure():
    thin, thick = (sound_speed_m_s(Air(humidity_percent=0, pressure_pa=pa)) for pa in (20_000, 200_000))
    assert thin == thick


@given(airs)
def test_speed_of_sound_is_plausible_for_any_air(air):
    steam = math.sqrt(1.33 * 461.5 * 333.15)  # the upper limit: water vapour at 60 °C
    assert 300 < sound_speed_m_s(air) <= steam + 1


@given(airs, st.floats(1, 20))
def test_speed_of_sound_rises_with_temperature(air, warmer_c):
    warm = air.replace(temperature_c=min(air.temperature_c + warmer_c, 60.0), humidity_percent=0.0)
    assert sound_speed_m_s(warm) >= sound_speed_m_s(air.replace(humidity_percent=0.0))


# ---- absorption ------------------------------------------------------------------------------------

TABLE_HZ = (20e3, 25e3, 30e3, 40e3, 50e3, 60e3, 80e3, 100e3)


@pytest.mark.parametrize(
    ("temperature_c", "humidity_percent", "wanted_db_m"),
    [
        (20, 50, (0.524, 0.732, 0.937, 1.318, 1.661, 1.980, 2.606, 3.280)),
        (25, 50, (0.464, 0.679, 0.911, 1.392, 1.861, 2.308, 3.148, 3.974)),
        (10, 70, (0.502, 0.655, 0.793, 1.037, 1.261, 1.487, 1.986, 2.581)),
        (0, 50, (0.253, 0.293, 0.339, 0.450, 0.590, 0.761, 1.193, 1.749)),
        (40, 50, (0.301, 0.456, 0.641, 1.094, 1.642, 2.267, 3.675, 5.206)),
        (20, 20, (0.506, 0.579, 0.646, 0.783, 0.940, 1.123, 1.577, 2.156)),
        (20, 90, (0.347, 0.522, 0.722, 1.173, 1.660, 2.158, 3.149, 4.126)),
    ],
)
def test_absorption_matches_iso_9613(temperature_c, humidity_percent, wanted_db_m):
    """At 101.325 kPa all digits of the table match."""
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    assert_allclose(absorption_db_m(air, np.array(TABLE_HZ)), wanted_db_m, atol=6e-4)


def test_absorption_matches_iso_9613_table_1():
    """Values of ISO 9613-1, table 1, for 10 °C and 10 %."""
    air = Air(temperature_c=10, humidity_percent=10)
    assert_allclose(1000 * absorption_db_m(air, np.array([100.0, 1000.0])), [0.585, 21.6], rtol=0.005)


def test_absorption_agrees_with_measurements():
    """Measurements by B. D. Lawrence and J. A. Simmons, JASA 71, 1982: 0.7 dB/m at 30 kHz and 8 dB/m at 200 kHz."""
    measured_db_m = np.array([0.7, 8.0])
    assert_allclose(absorption_db_m(Air(temperature_c=25), np.array([30e3, 200e3])), [0.91, 9.24], rtol=0.005)
    assert_allclose(absorption_db_m(Air(temperature_c=25), np.array([30e3, 200e3])), measured_db_m, rtol=0.35)


def test_dry_air_has_classical_absorption_at_ultrasound():
    """Without vapour oxygen relaxes at 24 Hz, which leaves classical absorption in ultrasound; it grows as f²."""
    dry = absorption_db_m(Air(humidity_percent=0), np.array([40e3, 80e3]))
    assert dry[1] / dry[0] == pytest.approx(4, rel=0.01)
    assert dry[0] < absorption_db_m(Air(humidity_percent=50), np.array([40e3]))[0]


@given(airs, st.floats(1, 1e6))
def test_absorption_is_finite_and_rises_with_frequency(air, frequency_hz):
    low, high = absorption_db_m(air, np.array([frequency_hz, 1.5 * frequency_hz]))
    assert 0 < low < high < 1e5
