"""Sample rates of time-expanded files, which play slower than the sound was recorded."""

from pathlib import Path
from typing import Final

from ertis_numba.base.errors import DataError
from ertis_numba.interop.recorder_metadata import RecorderMetadata

__all__ = ["true_rate_hz"]

_TOLERANCE: Final = 1e-3


def true_rate_hz(
    path: Path, header_hz: float, metadata: RecorderMetadata, expansion: float | None
) -> tuple[float, list[str]]:
    """Return the rate of the recorded sound and notes if it differs; expansion overrides the metadata."""
    stated = metadata.expansion
    ratio = None if metadata.rate_hz is None else metadata.rate_hz / header_hz
    if expansion is not None:
        differs = any(each is not None and not _equal(each, expansion) for each in (stated, ratio))
        text = _expanded(expansion, header_hz, "time_expansion")
        if differs:
            text += f", although the metadata state {_statement(metadata)}"
        return header_hz * expansion, [text] if differs or expansion != 1 else []
    if ratio is None:
        factor = stated or 1.0
        return header_hz * factor, [_expanded(factor, header_hz, "metadata")] if factor != 1 else []
    if stated is not None and _equal(stated, ratio):
        return header_hz * ratio, [_expanded(ratio, header_hz, "metadata")] if not _equal(ratio, 1) else []
    if stated in {None, 1.0} and (_equal(ratio, 1) or (ratio > 1.5 and _equal(ratio, round(ratio)))):
        factor = round(ratio)
        return header_hz * factor, [_expanded(factor, header_hz, "metadata")] if factor > 1 else []
    other = (
        f"time_expansion={ratio:.6g} if the metadata are right"
        if stated in {None, 1.0}
        else f"time_expansion={stated:g} if the file plays slower by this factor"
    )
    raise DataError(
        f"{path}: the header states {header_hz:g} Hz, but the metadata state {_statement(metadata)}; use "
        f"time_expansion=1 if the header is right, or {other}"
    )


def _expanded(factor: float, header_hz: float, source: str) -> str:
    if factor == 1:
        return f"the sample rate is {header_hz:g} Hz, as in the header ({source})"
    return f"time-expanded by {factor:g} ({source}): the sample rate is {header_hz * factor:g} Hz, not {header_hz:g} Hz"


def _statement(metadata: RecorderMetadata) -> str:
    parts = [f"a sample rate of {metadata.rate_hz:g} Hz"] if metadata.rate_hz else []
    parts += [f"a time expansion of {metadata.expansion:g}"] if metadata.expansion else []
    return " and ".join(parts)


def _equal(one: float, other: float) -> bool:
    return abs(one - other) <= _TOLERANCE * other
