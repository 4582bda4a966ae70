"""Limits beyond which a value is a fault; docs/health.md has the same."""

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
"""0.1 s of an eRTIS; more adds nothing."""
MIN_SAMPLES = 256
MIN_CHANGES = 1e-3
"""Share of samples; the bits of a silent modulator change two times out of three."""
# 17 equal bits are a mean beyond 0.88, which one-bit modulators follow no more. The direct sound of a real sensor
# has 0.03 % of the record in such runs, white bits 0.002 %, a call at full scale over a fourteenth of the record 1 %.
MAX_SATURATED = 2e-3
"""Share of places where 17 equal bits begin, or of numbers at full scale."""
MAX_OFFSET = 0.05
"""Takes a tenth of the half of full scale that modulators follow. A real sensor has 0.0002."""
OFFSET_DEVIATIONS = 5.0
"""Standard deviations of the mean of white bits, which count in short records."""
# Sound must stand out so far that its lack is no chance of the noise. The direct sound spreads by 6 dB, as the
# end of a line is twice as far from its middle as the median microphone; gains spread by a few more.
MIN_RISE_DB = 9.0
MIN_LEVEL_DB = -12.0
MAX_TONE_DB = 20.0
"""A real sensor's noise, redder below 1 kHz, stands out by 15 dB, reflectors by 5."""
COMMON_SHARE = 0.5
"""Share of the channels; a line that more of them hear is sound, or comes with the supply."""
MAX_GAIN_DB = 5.0
"""Five standard deviations of microphones whose gains spread by 1 dB."""
MAX_NOISE_DB = 8.0
"""Gains spread by 1 dB, and the noise of an eighth of a short record by 1 dB more."""
MAX_WHITE_DB = -3.0
"""Relative to white bits, whose mean square of 1 spreads evenly up to half of their rate."""
MAX_FLIPPED_DB = -18.0
"""Relative to white bits; 1 % of flipped bits has -14 dB, a microphone's noise of -30 dBFS has -30."""
MAX_FLIPS_DB = -8.0
"""Relative to white bits, above which bits are white rather than flipped: 4 % of flipped bits."""
MAX_STUCK_SAMPLES = 1024
"""Length of a stretch without a change; a call of 1 kHz that overloads a modulator changes twice as often."""
MAX_STUCK_NUMBERS = 64
"""The same of PCM, whose noise of two steps repeats a number in one sample of five."""
MAX_HUM = 0.03
"""Root mean square below the audible band, full scale 1. A real sensor has 0.0005."""
MIN_REPEATED_SAMPLES = 512
"""Noise and dither never repeat so many words."""
MAX_DELAY_S = 15e-6
"""Five standard deviations of microphones whose delays spread by 3 µs."""
MAX_SHIFT_S = 100e-6
"""Between the emission that the direct sound shows and the first sample."""
MAX_SWAP_DB = 6.0
"""Change from sample to sample of 16-bit numbers, relative to the same with swapped bytes."""
