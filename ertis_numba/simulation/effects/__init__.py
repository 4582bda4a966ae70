"""Effects on the sound, one module each.

`ertis_numba.simulation.needs` estimates which effects matter, and only their modules are imported.
"""
