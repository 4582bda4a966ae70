"""Options for the computation of images, and the settings that they make."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.settings import PresetKind, Settings


__all__ = ["grid_options", "image_options", "preset_completion", "processing_preset", "with_given"]


def preset_completion(kind: "PresetKind | None" = None) -> Callable[..., list[str]]:
    """Return a function that completes the names of presets in a shell."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:  # noqa: ARG001
        from ertis_numba.settings import presets

        return [name for name in presets(kind) if name.startswith(incomplete)]

    return complete


processing_preset: Callable[[Callable[..., Any]], Callable[..., Any]] = click.option(
    "--preset",
    metavar="NAME",
    shell_complete=preset_completion("processing"),
    help="Preset of directions and ranges, such as 2d_181_5m; 'ertis reference presets' lists all.",
)


def grid_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of the beam grid."""
    return _add(
        command,
        click.option(
            "--directions", metavar="GRID", help="90, 1850, 3000, 2d:N, 3d:N, or a CSV of azimuth, elevation in °."
        ),
        click.option("--azimuth", type=options.INTERVAL, help="Azimuth limits of 2d:N and 3d:N in °."),
        click.option(
            "--elevation", type=options.ELEVATION, help="Elevation limits A:B of 3d:N, or elevation E of 2d:N, in °."
        ),
    )


def image_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that change settings of images; the command passes all of them to `with_given`."""
    return _add(
        command,
        grid_options,
        click.option("--range", "range_m", type=options.INTERVAL, help="First and last range in m."),
        click.option("--method", type=click.Choice(["fast", "paper"]), help="Processing method."),
        options.beamforming(),
        options.cleaning(),
        click.option(
            "--array-weights",
            metavar="WINDOW",
            help="Window for the microphone weights, such as uniform, hann or taylor:35.",
        ),
        click.option(
            "--wavefront",
            type=click.Choice(["plane", "spherical", "auto"]),
            help="Wavefront model of echoes.",
        ),
        click.option(
            "--max-error",
            "max_error_db",
            type=options.ERROR_BUDGET,
            metavar="DB|PRESET",
            help="Error budget of images, as in -40, or draft, standard, fine, exact; the settings' own by default.",
        ),
    )


def with_given(
    recorded: "Settings", *, settings_file: Path | None, preset: str | None, given: Mapping[str, Any]
) -> "Settings":
    """Return the settings of a recording with a file, a preset and the options that were given."""
    renamed = {{"azimuth": "azimuth_limits_deg"}.get(name, name): value for name, value in given.items()}
    return options.settings_with(recorded, settings_file=settings_file, preset=preset, **renamed)


def _add(command: Callable[..., Any], *added: Callable[..., Any]) -> Callable[..., Any]:
    for option in reversed(added):
        command = option(command)
    return command
