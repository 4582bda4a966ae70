"""Headings of tables of microphone positions: axes, units, and columns that name or number the channels."""

import re
from dataclasses import dataclass
from typing import Final

from ertis_numba.settings import LENGTH_UNITS_M

__all__ = ["AXES", "ColumnHeading", "heading", "unit_in_comment", "unit_named"]

AXES: Final = "xyz"
_UNIT_WORDS: Final = {"millimetre": "mm", "centimetre": "cm", "metre": "m", "inch": "in", "inche": "in", '"': "in"}
"""Units by their names without the s of the plural."""
_OTHER_UNITS: Final = frozenset({"um", "µm", "μm", "micron", "dm", "km", "ft", "feet", "foot", "yd"})
_PLAIN_WORDS: Final = frozenset(
    {"x", "y", "z", "in", "of", "axis", "pos", "position", "coord", "coordinate", "mic", "forward", "left", "up"}
)
"""Words in headings of axes that are no units, even in brackets or behind the axis."""
_BRACKET: Final = re.compile(r"[\[(]\s*([^\W\d_]+)\s*[\])]|\b[xyz]_([^\W\d_]+)$")
_LABELS: Final = frozenset({"index", "unnamed", "name", "id", "label", "point", "row", "nr", "no", "number", "i", "n"})
_CHANNELS: Final = frozenset(
    {"channel", "channels", "ch", "chan", "mic", "mics", "microphone", "microphones", "sensor"}
)
_AXIS: Final = re.compile(r"(?:pos|coord|p|mic)?([xyz])(?:pos|position|coord|coordinate|axis)?(mm|cm|m|in)?")
_WORD: Final = re.compile(r'[^\W\d_]+|"')
_UNIT_IN_COMMENT: Final = re.compile(r"\b(?:in|units?)\b[\s:=(\[]*([^\W\d_]+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ColumnHeading:
    """Axis and unit in the heading of a column; empty for other columns, or without a unit, which may be unaccepted."""

    text: str = ""
    axis: str = ""
    unit: str = ""

    @property
    def numbers_channels(self) -> bool:
        """True for a column of numbers of channels, which must be complete."""
        return not self.axis and bool({*_words(self.text)} & _CHANNELS)

    @property
    def is_label(self) -> bool:
        """True for a column that names or numbers channels or rows; its heading may be empty."""
        return not self.axis and {*_words(self.text)} <= _LABELS | _CHANNELS


def heading(text: str) -> ColumnHeading:
    """Return the meaning of a heading, such as ``x_m``, ``Y [mm]`` or ``channel``."""
    words = _words(text)
    found = [match for match in map(_AXIS.fullmatch, words) if match]
    if len(found) != 1:
        return ColumnHeading(text)
    units = [_unit(word) or word for word in words if _unit(word) or word in _OTHER_UNITS]
    bracket = _BRACKET.search(text.lower().strip())
    if bracket and not units and (word := bracket[1] or bracket[2]) not in _PLAIN_WORDS:
        units = [word]
    if len(units) > 1 and "in" in units:  # the preposition, as in "x in mm"
        units.remove("in")
    return ColumnHeading(text, found[0][1], found[0][2] or next(iter(units), ""))


def unit_named(text: str) -> str:
    """Return the unit that a text consists of, such as m for ``[m]`` or ``Metres``; empty for other texts."""
    words = _words(text)
    return _unit(words[0]) if len(words) == 1 else ""


def unit_in_comment(text: str) -> str:
    """Return the unit that a comment names, as in ``positions in metres``; empty if it names none or several."""
    found = {_unit(word.lower()) for word in _UNIT_IN_COMMENT.findall(text)} - {""}
    return found.pop() if len(found) == 1 else ""


def _words(text: str) -> list[str]:
    return _WORD.findall(text.lower())


def _unit(word: str) -> str:
    return word if word in LENGTH_UNITS_M else _UNIT_WORDS.get(word.removesuffix("s").replace("meter", "metre"), "")
