"""Processing chain of RTIS Dev in NumPy with float64, written from the meaning of its arguments: the referee."""

import numpy as np

__all__ = ["limits", "processed"]


def processed(settings, words):
    """Process the PDM words of a measurement as an ``RTISSettings`` says: (row, sample) float64."""
    mics = [mic for mic in range(settings.nMicrophones) if mic not in set(np.ravel(settings.disableList))]
    bits = (np.asarray(words, dtype=np.uint32)[:, None] >> np.arange(settings.nMicrophones, dtype=np.uint32)) & 1
    factor = settings.pdmSubsampleFactor
    signals = filtered(2.0 * bits.T - 1.0, settings.pdmFilter)[:, ::factor][:, : len(words) // factor]
    if settings.preFilterEnable:
        signals = filtered(signals, settings.preFilter)
    if settings.matchedFilterEnable:
        response = np.asarray(settings.sigBaseMatchedFilterReal, np.float64) + 1j * settings.sigBaseMatchedFilterImag
        signals = np.fft.irfft(np.fft.rfft(signals) * response, signals.shape[1])
    if not settings.beamformingEnable:
        return signals
    rows = [
        image_row(settings, signals[mics], np.asarray(settings.delayMatrix)[mics, direction])
        for direction in range(settings.nDirections)
    ]
    return cleaned(settings, np.stack(rows))


def filtered(rows, taps):
    """Filter each row without delay."""
    taps = np.asarray(taps, np.float64).ravel()
    length = rows.shape[1] + len(taps) - 1
    full = np.fft.irfft(np.fft.rfft(rows, length) * np.fft.rfft(taps, length), length)
    begin = (len(taps) - 1) // 2
    return full[:, begin : begin + rows.shape[1]]


def image_row(settings, signals, delays):
    """Beam of one direction, and its envelope if that is enabled."""
    n_samples = signals.shape[1]
    delayed = np.zeros_like(signals)
    for row, signal, delay in zip(delayed, signals, delays, strict=True):
        row[: n_samples - delay] = signal[delay:]
    beam = combined(delayed, max(1, settings.dmasOrder))
    if settings.cfEnable:
        power = np.square(delayed).sum(axis=0)
        beam *= np.divide(delayed.sum(axis=0) ** 2, len(delayed) * power, out=np.zeros_like(power), where=power > 0)
    beam = beam[: n_samples - settings.beamformingDrop]
    if settings.postFilterEnable:
        beam = filtered(beam[None], settings.postFilter)[0]
    if not settings.enveloppeEnable:
        return beam
    smooth = filtered(np.pad(np.abs(beam), (0, settings.beamformingDrop))[None], settings.lpEsFilter)[0]
    return smooth[:: settings.energyscapeSubsampleFactor][settings.energyscapeSplStart : settings.energyscapeSplStop]


def combined(delayed, order):
    """Sum of the products of all combinations of ``order`` microphones, with roots so that the unit remains."""
    roots = np.sign(delayed) * np.abs(delayed) ** (1 / order)
    sums = [np.ones(delayed.shape[1]), *(np.zeros(delayed.shape[1]) for _ in range(order))]
    for root in roots:
        for k in range(order, 0, -1):
            sums[k] = sums[k] + sums[k - 1] * root
    return sums[order]


def cleaned(settings, image):
    """Set what is below the limits of its range to 0."""
    return np.where(image >= limits(settings, image), image, 0.0) if settings.cleanEnable else image


def limits(settings, image):
    """Smallest amplitude of each range that cleaning keeps."""
    mean, most = image.mean(axis=0), image.max(axis=0)
    return np.maximum(mean * settings.meanEnergyRangeMultiplier, most * settings.maxEnergyRangeThresholdMultiplier)
