"""Settings from an untrusted source: another machine, or a recording."""

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry.grids import grid_count
from ertis_numba.geometry.shipped_layouts import layout_names
from ertis_numba.settings import Settings

__all__ = ["received_settings"]


def received_settings(text: bytes | str, source: str, *, are_applied: bool = False) -> Settings:
    """Parse settings from an untrusted source, and reject names of files on this machine."""
    if isinstance(text, bytes):
        if len(text) > Settings.max_bytes:  # before a copy of it is made
            raise SettingsError(f"{source}: {len(text)} bytes; the limit is {Settings.max_bytes}")
        try:
            text = text.decode()
        except UnicodeDecodeError as error:
            raise SettingsError(f"{source}: not text ({error}); write TOML in UTF-8") from error
    settings = Settings.from_toml(text, source, find_line=False)
    layout, directions = settings.array.layout, settings.processing.directions
    if not layout.isprintable() or not str(directions).isprintable():
        raise SettingsError(f"{source}: a name has characters that cannot be printed; use printable characters")
    if settings.array.positions_m is None and layout not in layout_names():
        raise SettingsError(
            f"{source}: array.layout is {layout[:80]!r}, the name of a file; send its positions instead, or name one "
            f"of {', '.join(layout_names())}"
        )
    _require_numbers(settings, source, are_applied=are_applied)
    try:
        count = None if are_applied else grid_count(directions)
    except ArgumentError as error:
        raise SettingsError(f"{source}: {error}") from error
    if isinstance(directions, str) and count is None and not are_applied:
        raise SettingsError(
            f"{source}: processing.directions is {directions[:80]!r}, the name of a file; name a grid instead, such as "
            "2d:181"
        )
    return settings


def _require_numbers(settings: Settings, source: str, *, are_applied: bool) -> None:
    """Refuse names of files in place of samples, taps and, unless they are applied already, delays."""
    processing = settings.processing
    for name, value, wanted in (
        ("call.waveform", settings.call.waveform, "samples"),
        ("processing.delay_matrix", () if are_applied else processing.delay_matrix, "delays"),
        ("processing.pre_filter", processing.pre_filter, "taps"),
        ("processing.post_filter", processing.post_filter, "taps"),
    ):
        if isinstance(value, str):
            raise SettingsError(f"{source}: {name} is {value[:80]!r}, the name of a file; send its {wanted} instead")
