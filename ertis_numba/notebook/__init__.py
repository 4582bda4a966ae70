"""HTML for Jupyter: images, points, maps, recordings and settings."""

from ertis_numba.notebook.views import html_of

__all__ = ["html_of"]
