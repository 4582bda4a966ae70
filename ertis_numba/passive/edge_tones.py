"""Tones at the edges of bands, of whose power a band shows only a part."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.bands import bin_shares, typed_hz

__all__ = ["EdgeTones"]

_REACH: Final = 3  # Bins on each side of an edge that are examined.
_LINE: Final = 2  # Bins on each side into which the window spreads a tone.
_TAIL: Final = 0.12  # Largest power at the ends of a tone relative to its middle.
_MOST: Final = 0.5  # Least share of the tone in the power of a band in its direction.
_LOSS: Final = 0.11  # Share of the tone beyond an edge, -0.5 dB, that is worth a note.
_ROUNDING: Final = 1e-9
_WIDTH: Final = 0.15  # Half of the width of advised bands, relative to the tone.
_TINY: Final = 1e-30

Floats = NDArray[np.float64]


class _Edge(NamedTuple):
    """Edge with the bands that it bounds, and the bins around it: indices, -1 for those without power."""

    edge_hz: float
    bands: tuple[int, ...]
    bins: NDArray[np.intp]


class _Tone(NamedTuple):
    frequency_hz: float
    power: float


class EdgeTones:
    """Spectra at the edges of bands, at the microphones and in the loudest directions of the bands, over all maps."""

    # Directions show weaker tones, but beams of coarse grids distort the spectrum, so that microphones have priority.

    def __init__(self, band_hz: Floats, frequency_hz: Floats, highest_hz: float, *, is_linear: bool) -> None:
        self._band_hz, self._frequency_hz, self._highest_hz = band_hz, frequency_hz, highest_hz
        self._is_linear = is_linear
        self._spacing_hz = float(frequency_hz[1] - frequency_hz[0])
        self._shares = bin_shares(band_hz, frequency_hz)
        self._edges = [self._edge(edge_hz) for edge_hz in sorted(set(band_hz.ravel().tolist()))]
        self._lines = np.zeros((len(self._edges), len(band_hz), 2 * _REACH + 1))
        self._bands, self._count = np.zeros(len(band_hz)), 0
        self._heard = np.zeros(len(frequency_hz))

    def _edge(self, edge_hz: float) -> _Edge:
        near = np.abs(self._band_hz - edge_hz) <= _ROUNDING * edge_hz
        places = round((edge_hz - float(self._frequency_hz[0])) / self._spacing_hz) + np.arange(-_REACH, _REACH + 1)
        known = (places >= 0) & (places < len(self._frequency_hz))
        return _Edge(edge_hz, tuple(np.flatnonzero(near.any(axis=1)).tolist()), np.where(known, places, -1))

    def add(self, powers: NDArray[np.float32], power: NDArray[np.float32], heard: Floats, count: int) -> None:
        """Add powers (bin, direction), their map (direction, band), and the mean power (bin,) of the microphones."""
        loudest = power.argmax(axis=0)
        self._bands += count * power[loudest, np.arange(power.shape[1])]
        for number, edge in enumerate(self._edges):
            for band in edge.bands:
                line = np.where(edge.bins >= 0, powers[edge.bins, loudest[band]], 0.0)
                self._lines[number, band] += count * line
        self._heard += count * heard
        self._count += count

    def note(self, *, within: bool = False) -> str | None:
        """Return a note on the loudest tone of whose power a band shows only a part; None without any."""
        tones = [
            (edge, tone)
            for number, edge in enumerate(self._edges)
            for band in edge.bands
            if (len(edge.bands) > 1 or not within) and (tone := self._found(number, band)) is not None
        ]
        if not tones:
            return None
        edge, tone = max(tones, key=lambda each: each[1].power)
        level = f"{10 * math.log10(tone.power / self._count):.1f} dBFS"
        frequency = f"{tone.frequency_hz / 1e3:.4g} kHz"
        where = "lies at the edge of two bands, each of which shows a part of its power"
        if len(edge.bands) == 1:
            where = f"lies at the edge of the bands, {edge.edge_hz / 1e3:.4g} kHz, which show a part of its power"
        return f"a tone at {frequency} of about {level} {where}; {self._remedy(tone.frequency_hz)}"

    def _remedy(self, frequency_hz: float) -> str:
        low_hz, high_hz = (1 - _WIDTH) * frequency_hz, min((1 + _WIDTH) * frequency_hz, self._highest_hz)
        if frequency_hz + 3 * self._spacing_hz > self._highest_hz:
            return f"for its level, record at a higher rate: bands end at {self._highest_hz / 1e3:.4g} kHz"
        return f"for its level, use the band {typed_hz(low_hz)}:{typed_hz(high_hz)} Hz (passive.bands_hz)"

    def _found(self, number: int, band: int) -> _Tone | None:
        """Return the tone at an edge that dominates a band at the microphones, or else in its loudest direction."""
        edge = self._edges[number]
        heard = np.where(edge.bins >= 0, self._heard[edge.bins], 0.0)
        if self._is_line(edge, heard):
            return self._tone(edge, band, heard, float(self._shares[band] @ self._heard))
        line = self._lines[number, band]
        is_shown = self._is_linear and self._is_line(edge, line)
        return self._tone(edge, band, line, self._bands[band]) if is_shown else None

    @staticmethod
    def _middle(line: Floats) -> int:
        """Return the place of the strongest of the three bins around an edge."""
        return _REACH - 1 + int(line[_REACH - 1 : _REACH + 2].argmax())

    def _is_line(self, edge: _Edge, line: Floats) -> bool:
        """Return True if a spectrum shows a tone at an edge."""
        middle = self._middle(line)
        ends = line[[middle - _LINE, middle + _LINE]].max()
        is_top = line[middle] >= line[[middle - 1, middle + 1]].max()
        return bool(edge.bins[middle] >= 0 and is_top and line[middle] > _TINY and ends <= _TAIL * line[middle])

    def _tone(self, edge: _Edge, band: int, line: Floats, all_power: float) -> _Tone | None:
        """Return the tone of a spectrum at an edge, if it dominates the power of a band."""
        middle = self._middle(line)
        part = slice(middle - _LINE, middle + _LINE + 1)
        bins, tone = edge.bins[part], line[part]
        known = bins >= 0
        inside = float(np.where(known, self._shares[band, bins], 0.0) @ tone)
        power = float(tone.sum())
        places = float(np.where(known, bins, 0) @ tone) / power
        if not known.all():
            places, power = _of_part(bins, tone)
        if inside < _MOST * all_power or power - inside < _LOSS * power:
            return None
        return _Tone(float(self._frequency_hz[0]) + self._spacing_hz * places, power)


def _of_part(bins: NDArray[np.intp], tone: Floats) -> tuple[float, float]:
    """Return the place of a tone in bins, and its power, from its strongest bin and the next one inside."""
    step = 1 if bins[_LINE + 1] >= 0 else -1
    if bins[_LINE - 1] >= 0 and bins[_LINE + 1] >= 0:
        step = 1 if bins[0] < 0 else -1
    ratio = math.sqrt(tone[_LINE + step] / tone[_LINE])
    offset = max(-1.0, (2 * ratio - 1) / (ratio + 1))
    middle = np.sinc(offset) / (1 - offset**2) if abs(offset) < 1 - _ROUNDING else 0.5
    return float(bins[_LINE] + step * offset), 1.5 * float(tone[_LINE]) / float(middle) ** 2
