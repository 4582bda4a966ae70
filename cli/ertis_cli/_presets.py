"""Options that name a shipped preset."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ertis_numba.settings import PresetKind

__all__ = ["completion", "processing_preset"]


def completion(kind: "PresetKind | None" = None) -> Callable[..., list[str]]:
    """Return a function that completes the names of presets in a shell."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:  # noqa: ARG001
        from ertis_numba.settings import presets

        return [name for name in presets(kind) if name.startswith(incomplete)]

    return complete


processing_preset: Callable[[Callable[..., Any]], Callable[..., Any]] = click.option(
    "--preset",
    metavar="NAME",
    shell_complete=completion("processing"),
    help="Preset of directions and ranges, such as 2d_181_5m; 'ertis reference presets' lists all.",
)
