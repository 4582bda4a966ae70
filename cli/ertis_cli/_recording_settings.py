"""Options that name the settings of measurements."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _image_options, options

if TYPE_CHECKING:
    from ertis_numba.settings import Settings

__all__ = ["recording_settings", "settings_from", "warn_without_images"]

_OPTIONS = (
    click.option(
        "--call",
        "call_file",
        type=options.FILE,
        metavar="FILE",
        help="Waveform of the call: .wav, or .csv or .npy with samples at 450 kHz.",
    ),
    click.option(
        "--preset",
        metavar="NAME",
        shell_complete=_image_options.preset_completion("recording"),
        help="Record length (short_, default_, long_) and band (20_80, 25_50); default_25_50 by default, except for "
        "'ertis sensors configure'.",
    ),
    click.option(
        "--layout",
        metavar="NAME",
        shell_complete=options.complete_layouts,
        help="Name of a shipped layout, or a layout file such as .csv or .toml; eRTIS_v3D1 by default.",
    ),
    click.option("--settings", "settings_file", type=options.FILE, metavar="FILE", help="Settings file (TOML)."),
    click.option("--temperature", type=float, metavar="C", help="Air temperature in °C; 20 by default."),
)


def recording_settings(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command, which passes their values to `settings_from`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def settings_from(
    *,
    preset: str | None,
    layout: str | None,
    settings_file: Path | None,
    temperature: float | None,
    call_file: Path | None,
) -> "Settings":
    """Return settings from a preset or a file, with the given layout, air temperature and call."""
    from ertis_numba.settings import Air, Array, Call, Settings

    if settings_file is not None and preset is not None:
        raise click.UsageError("--preset and --settings cannot be combined; choose one of them")
    settings = Settings.load(settings_file) if settings_file else Settings.from_preset(preset or "default_25_50")
    if layout is not None:
        settings = settings.replace(array=Array(layout=layout))
    options.note_layout(settings.array)
    if temperature is not None:
        air = Air() if settings_file is None else settings.air
        settings = settings.replace(air=air.replace(temperature_c=temperature))
    if call_file is not None:
        settings = settings.replace(call=Call.from_file(call_file))
    return settings


def warn_without_images(settings: "Settings") -> None:
    """Print a warning if no image can be computed from measurements with these settings."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.chain.memory import require_images

    try:
        require_images(settings)
    except ArgumentError as error:
        options.warn(f"images of these measurements need other settings: {error}")
