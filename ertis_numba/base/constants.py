"""Physical constants, properties of the eRTIS hardware, and limits, each with its source."""

from typing import Final, Literal, TypeAlias, get_args

__all__ = [
    "ERTIS_PDM_RATE_HZ",
    "FALSE_ALARM",
    "IMAGE_DTYPES",
    "MAX_MICROPHONES",
    "MAX_NAME_LENGTH",
    "SHAPED_NOISE_SHARE",
    "STANDARD_HUMIDITY_PERCENT",
    "STANDARD_PRESSURE_PA",
    "STANDARD_TEMPERATURE_C",
    "SYNC_STEP_S",
    "WORD_BITS",
    "ImageDtype",
]

STANDARD_TEMPERATURE_C: Final = 20.0
STANDARD_HUMIDITY_PERCENT: Final = 50.0
STANDARD_PRESSURE_PA: Final = 101_325.0  # ISO 9613-1, reference pressure

ERTIS_PDM_RATE_HZ: Final = 4_500_000.0  # eRTIS in ultrasonic mode
# Measured on a real sensor at 4.5 MHz: the noise is flat up to 130 kHz, 4 dB higher at 140 kHz, and 25 dB at 250 kHz.
SHAPED_NOISE_SHARE: Final = 130e3 / 4.5e6
"""Frequency above which the shaped quantisation noise of one-bit microphones dominates, relative to their clock."""
SYNC_STEP_S: Final = 400e-9  # delay between neighbours in the SYNC chain; Jansen et al., 2019

FALSE_ALARM: Final = 1e-3
"""Probability that noise alone yields a reflector in an image, or a bearing in a map, by default."""

MAX_MICROPHONES: Final = 1024
MAX_NAME_LENGTH: Final = (
    4096  # characters of a name or path in settings: PATH_MAX of Linux; the limit of HDF5 is 65,536 bytes
)
WORD_BITS: Final = (8, 16, 32, 64)

ImageDtype: TypeAlias = Literal["float32", "float16", "uint8"]
IMAGE_DTYPES: Final[tuple[ImageDtype, ...]] = get_args(ImageDtype)
"""Data types of stored and published images."""
