"""What can happen to the sound, one file each.

None of them decides whether it is needed: `ertis_numba.simulation.needs` asks that, and only what is
needed is imported.
"""
