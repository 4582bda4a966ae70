"""Layout of the HTML of an object: title, axes, list, notes and picture."""

import io
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ErtisError
from ertis_numba.base.html_parts import escaped, picture, table

__all__ = ["Axis", "page"]

_DPI: Final = 80
_STYLE: Final = (
    ".ertis td, .ertis th { text-align: left; padding: 0.1rem 0.6rem 0.1rem 0; } "
    ".ertis .number { text-align: right; font-variant-numeric: tabular-nums; } "
    ".ertis .scroll { overflow-x: auto; } .ertis img { max-width: min(100%, 54rem); height: auto; }"
)


class Axis(NamedTuple):
    """Array of an object, its axes by name, and the unit of its values."""

    name: str
    axes: str
    values: NDArray[Any]
    unit: str
    about: str

    def cells(self) -> list[tuple[str, str]]:
        """Return the row of a table: name, axes, lengths, type, least and greatest value, and meaning."""
        lengths = " × ".join(map(str, self.values.shape))
        texts = (self.name, f"({self.axes})", lengths, str(self.values.dtype), self._limits(), self.about)
        return [(escaped(text), "") for text in texts]

    def _limits(self) -> str:
        if not self.values.size:
            return "no values"
        unit = f" {self.unit}" if self.unit else ""
        if not np.isfinite(self.values).all():
            return "with NaN or infinity"
        return f"{self.values.min():.6g} to {self.values.max():.6g}{unit}"


def page(
    title: str,
    axes: Sequence[Axis],
    listed: tuple[str, str],
    notes: Sequence[str],
    draw: Callable[[Any], Any],
) -> str:
    """Return HTML that needs no other file and no script."""
    # `listed` is the content in HTML, and the text if it is empty. `draw` draws with the room `figures`, if anything.
    rows, missing = listed
    heads = [(name, "") for name in ("array", "axes", "shape", "type", "values", "meaning")]
    return "\n".join(
        (
            f"<div class=ertis><style>{_STYLE}</style><p><b>{escaped(title)}</b></p>",
            _drawn(title, draw),
            rows or f"<p>{escaped(missing)}</p>",
            *(f"<p>Note: {escaped(note)}</p>" for note in notes),
            table(heads, [axis.cells() for axis in axes]) if axes else "",
            "</div>",
        )
    )


def _drawn(title: str, draw: Callable[[Any], Any]) -> str:
    """Return the picture, or the reason for which there is none."""
    try:
        from ertis_numba import figures  # noqa: PLC0415  Matplotlib takes longer to import than all the rest.

        figure = draw(figures)
        if figure is None:
            return ""
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=_DPI)
    except (ErtisError, ImportError) as error:
        return f"<p>No picture: {escaped(str(error))}</p>"
    return picture(content.getvalue(), title)
