"""Limits beyond which a value is a fault, as documented in docs/how-to/health.md."""

__all__ = [
    "COMMON_SHARE",
    "MAX_DELAY_S",
    "MAX_FLIPPED_DB",
    "MAX_FLIPS_DB",
    "MAX_GAIN_DB",
    "MAX_HUM",
    "MAX_NOISE_DB",
    "MAX_OFFSET",
    "MAX_SAMPLES",
    "MAX_SATURATED",
    "MAX_SHIFT_S",
    "MAX_STUCK_NUMBERS",
    "MAX_STUCK_SAMPLES",
    "MAX_SWAP_DB",
    "MAX_TONE_DB",
    "MAX_WHITE_DB",
    "MIN_CHANGES",
    "MIN_LEVEL_DB",
    "MIN_REPEATED_SAMPLES",
    "MIN_RISE_DB",
    "MIN_SAMPLES",
    "OFFSET_DEVIATIONS",
]

MAX_SAMPLES = 2**19
"""Number of samples to check: 0.1 s of an eRTIS. More samples add no information."""
MIN_SAMPLES = 256
MIN_CHANGES = 1e-3
"""Share of samples at which a bit changes. The bits of a silent modulator change at two out of three samples."""
# 17 equal bits correspond to a mean above 0.88, beyond the range of one-bit modulators. Such runs cover 0.03 % of the
# record in the direct sound of a real sensor, and 0.002 % in white bits. They cover 1 % if a call at full scale lasts a
# fourteenth of the record.
MAX_SATURATED = 2e-3
"""Share of samples at which 17 equal bits start, or of PCM samples at full scale."""
MAX_OFFSET = 0.05
"""Mean of a channel: a tenth of the half of full scale that modulators can follow. A real sensor has 0.0002."""
OFFSET_DEVIATIONS = 5.0
"""Limit in standard deviations of the mean of white bits, which matters in short records."""
# Sound must exceed the noise so far that its absence cannot be chance. The levels of the direct sound differ by 6 dB,
# since the end of a line is twice as far from its middle as the median microphone. Gains add a few decibels.
MIN_RISE_DB = 9.0
MIN_LEVEL_DB = -12.0
MAX_TONE_DB = 20.0
"""Level relative to the surrounding lines. A real sensor's noise, which rises below 1 kHz, has 15 dB, reflectors 5 dB.
"""
COMMON_SHARE = 0.5
"""Share of the channels above which a line is sound or comes from the power supply."""
MAX_GAIN_DB = 5.0
"""Five standard deviations for microphones whose gains have a standard deviation of 1 dB."""
MAX_NOISE_DB = 8.0
"""Noise relative to the median: gains vary by 1 dB, and the noise of an eighth of a short record by 1 dB more."""
MAX_WHITE_DB = -3.0
"""Level relative to white bits, whose mean square of 1 spreads evenly up to half of their rate."""
MAX_FLIPPED_DB = -18.0
"""Level relative to white bits: 1 % of flipped bits has -14 dB, and a microphone's noise of -30 dBFS has -30 dB."""
MAX_FLIPS_DB = -8.0
"""Level relative to white bits above which bits are white rather than flipped: that of 4 % of flipped bits."""
MAX_STUCK_SAMPLES = 1024
"""Length of a section without a change. A call of 1 kHz that overloads a modulator changes twice as often."""
MAX_STUCK_NUMBERS = 64
"""Length of a section of PCM without a change. Noise of two steps repeats the value in one of five samples."""
MAX_HUM = 0.03
"""Root mean square below the audible band, relative to full scale. A real sensor has 0.0005."""
MIN_REPEATED_SAMPLES = 512
"""Length of a repeated block. Noise and dither never repeat so many samples."""
MAX_DELAY_S = 15e-6
"""Five standard deviations for microphones whose delays have a standard deviation of 3 µs."""
MAX_SHIFT_S = 100e-6
"""Time between the emission, as derived from the direct sound, and the first sample."""
MAX_SWAP_DB = 6.0
"""Differences between consecutive 16-bit samples, relative to those with swapped bytes."""
