"""Measure speed: `paper` and `scaling` are run by ``ertis bench``."""
