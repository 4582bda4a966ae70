"""Speed of sound, absorption and transmission loss in air."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Air

__all__ = ["absorption_db_m", "sound_speed_m_s", "transmission_loss_db"]

_ZERO_C_K = 273.15
_TRIPLE_POINT_K = 273.16  # of water; ISO 9613-1, annex B
_REFERENCE_K = 293.15
_REFERENCE_PRESSURE_PA = 101_325.0
_DB_PER_NEPER = 20 / math.log(10)
_DRY_AIR_KG_MOL = 0.028_964_5
_WATER_KG_MOL = 0.018_015_28
_GAS_CONSTANT_J_MOL_K = 8.314_462_618  # CODATA 2018
_DRY_HEAT_RATIO = 1.400
_VAPOUR_HEAT_RATIO = 1.330


def sound_speed_m_s(air: Air) -> float:
    """Return the speed of sound in humid air, ``c = sqrt(γ R T / M)`` of an ideal mixture of dry air and water vapour.

    The saturation pressure is that of ISO 9613-1, annex B. Dry air at 0 °C gives 331.3 m/s.
    """
    kelvin = _ZERO_C_K + air.temperature_c
    vapour = _water_vapour_fraction(air)
    molar_mass = (1 - vapour) * _DRY_AIR_KG_MOL + vapour * _WATER_KG_MOL
    # 1 / (γ − 1) is the heat capacity over R, which adds up over the parts of the mixture.
    capacity = (1 - vapour) / (_DRY_HEAT_RATIO - 1) + vapour / (_VAPOUR_HEAT_RATIO - 1)
    return math.sqrt((1 + 1 / capacity) * _GAS_CONSTANT_J_MOL_K * kelvin / molar_mass)


def absorption_db_m(air: Air, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the absorption of a plane wave in dB/m: (frequency,); ISO 9613-1:1993, equations 3 to 5 and annex B."""
    kelvin = _ZERO_C_K + air.temperature_c
    pressure = air.pressure_pa / _REFERENCE_PRESSURE_PA
    warmth = kelvin / _REFERENCE_K
    vapour_percent = 100 * _water_vapour_fraction(air)
    oxygen_hz = pressure * (24 + 4.04e4 * vapour_percent * (0.02 + vapour_percent) / (0.391 + vapour_percent))
    nitrogen_hz = (
        pressure / math.sqrt(warmth) * (9 + 280 * vapour_percent * math.exp(-4.170 * (warmth ** (-1 / 3) - 1)))
    )
    classical = 1.84e-11 / pressure * math.sqrt(warmth)
    oxygen = 0.012_75 * math.exp(-2239.1 / kelvin) / (oxygen_hz + frequency_hz**2 / oxygen_hz)
    nitrogen = 0.1068 * math.exp(-3352.0 / kelvin) / (nitrogen_hz + frequency_hz**2 / nitrogen_hz)
    return np.asarray(_DB_PER_NEPER * frequency_hz**2 * (classical + warmth**-2.5 * (oxygen + nitrogen)))


def transmission_loss_db(air: Air, distance_m: float, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transmission loss of a spherical wave, ``20 log10(r / 1 m) + α r``, in dB: (frequency,)."""
    # See R. J. Urick, Principles of Underwater Sound, 1983.
    return 20 * math.log10(distance_m) + distance_m * absorption_db_m(air, frequency_hz)


def _water_vapour_fraction(air: Air) -> float:
    """Return the molar share of water vapour."""
    kelvin = _ZERO_C_K + air.temperature_c
    saturation: float = 10.0 ** (4.6151 - 6.8346 * (_TRIPLE_POINT_K / kelvin) ** 1.261)
    share = air.humidity_percent / 100 * saturation * _REFERENCE_PRESSURE_PA / air.pressure_pa
    return min(share, 1.0)  # Hot and thin air is pure steam at most.
