"""Positions of the microphones of known arrays, as data files."""
