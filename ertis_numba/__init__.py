"""Imaging sonar in air: from one-bit microphone data to energyscapes and reflectors.

These examples use the files that ``ertis example reflectors corridor`` writes::

    import ertis_numba as ertis

    recording = ertis.open_recording("reflectors.h5")
    pipeline = ertis.Pipeline(recording.settings)
    image = pipeline.process(recording[0])
    peaks = ertis.find_peaks(image, top=5)
    ertis.plot(image, peaks=peaks).savefig("image.png")

Simulate a scene and compare the image with its ground truth::

    simulator = ertis.Simulator(ertis.load_scene("corridor.toml"))
    image = ertis.Pipeline(simulator.sensor.settings()).process(simulator.render(0))
    comparison = ertis.compare(image, simulator.reflectors(0))

Names are imported when they are first used: ``import ertis_numba`` loads neither NumPy, Numba nor SciPy.
"""

from typing import Any

import lazy_loader

from ertis_numba.base import notebook_html

_attach, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    return _version() if name == "__version__" else _attach(name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


def _html_of(shown: Any) -> str:
    from ertis_numba.notebook import html_of  # noqa: PLC0415  is needed in notebooks only

    return html_of(shown)


notebook_html.renderer = _html_of


def _version() -> str:
    from importlib import metadata  # noqa: PLC0415  takes longer to import than the rest of this file

    try:
        return metadata.version("ertis-numba")
    except metadata.PackageNotFoundError:  # the package runs from its source without being installed
        return "unknown"
